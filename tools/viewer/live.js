// Compression-ratio slider.

const LEAST_RATIO = 0.01;
// Increases with every request, also across pages: the server cancels lower numbers.
let lastRequest = Date.now() * 1000;

async function asked(address, options) {
    const answer = await fetch(address, options).catch(error => {
        throw error.name === "AbortError" ? error : new Error("zipsplat view does not answer: it may have ended.");
    });
    if (!answer.ok) throw new Error(await answer.text());
    return answer;
}

async function made(address, signal) {
    const bytes = new Uint8Array(await (await asked(address, { signal })).arrayBuffer()), end = bytes.indexOf(10);
    return { facts: JSON.parse(new TextDecoder().decode(bytes.subarray(0, end))), bytes: bytes.slice(end + 1).buffer };
}

class Live {
    constructor(page) {
        this.page = page;
        const { live } = config;
        if (!live) return;
        this.index = page.scenes.push({ name: "photos", loading: true, extension: ".ply" }) - 1;
        element("ratio").value = 100 * (1 - Math.log(live.ratio) / Math.log(LEAST_RATIO));
        element("ratio").oninput = () => this.ask();
        element("precision").hidden = live.precisions.length < 2;
        element("precision").append(...live.precisions.map(name => new Option(name)));
        element("precision").onchange = () => this.ask();
        this.ask();
    }

    // Logarithmic, from the least ratio to 1.
    get ratio() { return Number(Math.max(LEAST_RATIO, LEAST_RATIO ** (1 - element("ratio").value / 100)).toPrecision(3)); }

    async ask() {
        this.waiting?.abort();
        const waiting = this.waiting = new AbortController(), begin = performance.now();
        const source = `made/${this.ratio}/${element("precision").value}`;
        element("ratio-label").textContent = `Ratio ${this.ratio}: asked for`;
        try {
            const { facts, bytes } = await made(`${source}?${++lastRequest}`, waiting.signal), received = performance.now();
            await this.page.swap(this.index, { ...facts, source }, bytes);
            if (this.waiting === waiting) this.tell(facts, received - begin, performance.now() - received);
        } catch (error) {
            if (!waiting.signal.aborted) this.page.failed(this.index, error.message);
        }
    }

    tell(facts, answered, loaded) {
        const made = facts.times.reduce((sum, [, ms]) => sum + ms, 0), { tokens } = config.live;
        const times = [...facts.times, ["send", Math.max(0, answered - made)], ["load", loaded]];
        this.took = { total: answered + loaded, times };
        const kept = `${facts.patches.length.toLocaleString("en")} of ${counted(tokens, "token")}`;
        element("ratio-label").textContent = `Ratio ${this.ratio}: ${kept}, ${counted(this.page.scenes[this.index].count, "Gaussian")}, ` +
            `${sized(facts.bytes)} in ${Math.round(this.took.total)} ms: ${times.map(([stage, ms]) => `${stage} ${Math.round(ms)}`).join(", ")}`;
    }
}
