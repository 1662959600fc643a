const OFTEN = 250; // milliseconds between polls

class Refining {
    constructor(page) {
        this.page = page;
        if (!config.refines) return;
        this.index = page.scenes.push({ name: "refinement", loading: true, source: "refined", extension: ".ply" }) - 1;
        this.version = 0;
        element("stop").onclick = () => {
            element("stop").disabled = true;
            asked("refining/stop", { method: "POST" }).catch(error => page.say(error.message, true));
        };
        this.look();
    }

    async look() {
        try {
            const state = this.state = await (await asked("refining")).json();
            this.tell(state);
            if (state.version !== this.version) {
                const { facts, bytes } = await made("refined");
                await this.page.swap(this.index, facts, bytes);
                if (!this.version) this.page.choose(this.index);
                this.version = state.version;
            }
            if (state.ended) return void (element("stop").hidden = true);
        } catch (error) {
            element("refined-label").textContent = error.message;
        }
        setTimeout(() => this.look(), OFTEN);
    }

    tell({ step, steps, losses, psnr, seconds_left, ended }) {
        const facts = [ended ?? `Step ${step} of ${steps}`];
        if (losses.length) facts.push(`loss ${losses[0].toFixed(4)} to ${losses.at(-1).toFixed(4)}`);
        if (psnr.length) facts.push(`held-out photos ${psnr[0][1].toFixed(2)} to ${psnr.at(-1)[1].toFixed(2)} dB`);
        if (!ended && step) facts.push(`${Math.ceil(seconds_left)} s left`);
        element("refined-label").textContent = facts.join(" · ");
        this.plot(losses, steps);
    }

    plot(losses, steps) {
        const canvas = element("losses"), context = canvas.getContext("2d"), most = Math.max(...losses, 1e-9);
        canvas.width = canvas.clientWidth;
        canvas.height = canvas.clientHeight;
        context.strokeStyle = "#7cf";
        context.lineWidth = 1.5;
        context.beginPath();
        for (const [i, loss] of losses.entries())
            context.lineTo(i / Math.max(1, steps - 1) * canvas.width, canvas.height - 2 - loss / most * (canvas.height - 4));
        context.stroke();
    }
}
