// View modes and skipped effects.

class Views {
    constructor(page) {
        this.page = page;
        this.shown = "color";
        element("shown").onchange = event => this.show(event.target.value);
        const stops = PALETTE.map(rgb => `rgb(${rgb.map(value => Math.round(255 * value))})`);
        element("palette").style.background = `linear-gradient(90deg, ${stops})`;
    }

    show(shown) {
        const { page } = this;
        if (shown === "tokens" && !page.tokens.group) {
            page.say("Which Gaussians are of one token is not known here: view PHOTOS knows, and --gaussians-per-token N says so.");
            setTimeout(() => page.say(""), 4000);
            shown = "color";
        }
        this.shown = element("shown").value = shown;
        element("depths").hidden = shown !== "depth";
        page.tokens.leave();
        page.change();
    }

    drawn() {
        const { shown, page: { tokens } } = this;
        return { shown, group: tokens.group || 1, hovered: tokens.hovered, range: shown === "depth" ? this.depths() : [0, 1] };
    }

    // Palette range, of most visible points.
    depths() {
        const { camera, scene } = this.page, points = scene?.sample ?? [], depths = [];
        for (let i = 0; i < points.length; i += 3) {
            const depth = dot(camera.axes[2], [0, 1, 2].map(c => points[i + c] - camera.eye[c]));
            if (depth > scene.near) depths.push(depth);
        }
        depths.sort((a, b) => a - b);
        const at = share => depths[Math.floor(share * (depths.length - 1))] ?? 1;
        const range = [at(0.02), Math.max(at(0.95), 1.001 * at(0.02))];
        element("nearest").textContent = range[0].toPrecision(3);
        element("farthest").textContent = range[1].toPrecision(3);
        return range;
    }

    tellLeftOut() {
        const { scene } = this.page, whole = number => number.toLocaleString("en"), facts = [];
        if (scene?.drawable) {
            const { count, faint, near, drawable: { drawn } } = scene;
            facts.push(`${whole(drawn)} of ${counted(count, "Gaussian")} drawn: ${whole(faint)} are fainter than 1/255, ` +
                `${whole(count - faint - drawn)} lie behind the camera or nearer than ${near}.`);
            if (scene.late !== undefined) facts.push(`The order by depth was ${Math.round(scene.late)} ms late.`);
            facts.push(...scene.skipped_passes?.map(({ what, why }) => `No ${what}: ${why}.`) ?? []);
        }
        element("left-out").textContent = facts.join(" ");
    }
}
