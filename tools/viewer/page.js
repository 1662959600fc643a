const element = id => document.getElementById(id);
const config = JSON.parse(element("config").textContent);
const counted = (count, what) => `${count.toLocaleString("en")} ${what}${count === 1 ? "" : "s"}`;
const sized = bytes => bytes < 1e6 ? `${(bytes / 1e3).toFixed(1)} kB` : `${(bytes / 1e6).toFixed(1)} MB`;

const SLOW = 60; // milliseconds per frame; slower motion lowers the resolution
const PREVIEWED = 1 << 24; // bytes; smaller scenes are shown whole
const FIRST = 1 / 16; // part shown first, then four times as much
const REST = 250; // idle milliseconds before full resolution

class Page {
    constructor() {
        this.canvas = element("picture");
        this.camera = new ViewCamera();
        this.renderer = new Renderer(this.canvas);
        this.scenes = config.scenes.map((scene, i) => ({ ...scene, inlined: element(`scene-${i}`), extension: ".ply" }));
        for (const [i, scene] of this.scenes.entries()) if (!scene.inlined) scene.source = `scene/${i}`;
        this.current = 0;
        this.background = [0, 0, 0];
        this.coarse = 1;
        this.moved = 0;
        this.times = [];
        this.worker = new Worker(URL.createObjectURL(new Blob([element("worker").textContent], { type: "text/javascript" })));
        this.worker.onmessage = ({ data }) => this.answered(data);
        this.worker.onerror = event => this.say(`The page's worker failed: ${event.message}`, true);
        this.controls = new Controls(this.canvas, this.camera, () => this.change(true));
        this.overlay = new Overlay(this);
        this.tokens = new Tokens(this);
        this.views = new Views(this);
        this.path = new Path(this);
        this.live = new Live(this);
        this.refining = new Refining(this);
        this.edit = new Edit(this);
        this.buttons();
        addEventListener("resize", () => {
            if (!this.overlay.photo.hidden) this.through(this.input);
            this.change();
        });
        this.canvas.addEventListener("webglcontextlost", event => {
            event.preventDefault();
            this.say("The graphics driver stopped. Reload the page to go on.", true);
        });
        if (this.scenes.length) this.choose(0);
        else this.say("Drop a PLY, SPZ, SOG, .splat or glTF here, or press Open.");
    }

    get scene() { return this.scenes[this.current]; }

    get stem() { return (this.scene?.name || "scene").replace(/\.\w+$/, "").replace(/\s+/g, "-"); }

    say(text, failed = false) {
        element("message").textContent = text;
        element("message").classList.toggle("failed", failed);
        element("message").hidden = !text;
    }

    choose(index) {
        this.current = Math.max(0, Math.min(this.scenes.length - 1, index));
        const { scene } = this;
        if (scene.failed) this.say(`${scene.name}: ${scene.failed}`, true);
        else if (!scene.loading) this.load(this.current);
        else this.say(scene.drawable ? "" : `${scene.name}: ${scene.arriving ?? "loading"}`);
        if (!this.home) this.reset();
        this.tokens.leave();
        this.edit.enter();
        this.label();
        this.change();
    }

    async load(index) {
        const scene = this.scenes[index];
        scene.loading = true;
        this.say(`${scene.name}: loading`);
        try {
            const bytes = await this.bytes(scene, index);
            scene.bytes ??= bytes.byteLength;
            const { features, name } = scene, parts = { name, inlined: element(`features-${index}`), source: `features/${index}` };
            this.read(index, bytes, true, { features: features && { ...features, values: new Int8Array(await this.bytes(parts)) } });
        } catch (error) {
            this.failed(index, error.message);
        }
    }

    // With any view for the first depth order.
    read(index, bytes, whole = true, { features, swap } = {}) {
        const scene = this.scenes[index], view = this.home && this.view();
        if (whole && !scene.file) scene.blob = new Blob([bytes]);
        this.worker.postMessage({ load: index, bytes, name: scene.name, view, whole, features, swap }, [bytes]);
    }

    // Resolves when the new scene is shown.
    swap(index, facts, bytes) {
        const scene = this.scenes[index];
        scene.done?.();
        return new Promise(resolve => {
            scene.done = resolve;
            scene.next = facts;
            scene.swap = (scene.swap ?? 0) + 1;
            this.read(index, bytes, true, { swap: scene.swap });
        });
    }

    // Dropped, embedded or from the server.
    async bytes(scene, index) {
        if (scene.file) return scene.file.arrayBuffer();
        const { inlined } = scene;
        if (inlined) {
            const text = inlined.textContent, padding = text.endsWith("==") ? 2 : text.endsWith("=") ? 1 : 0;
            const bytes = new Uint8Array(text.length / 4 * 3 - padding), part = 1 << 20;
            for (let at = 0; at < text.length; at += part) {
                const binary = atob(text.slice(at, at + part));
                for (let i = 0; i < binary.length; ++i) bytes[at / 4 * 3 + i] = binary.charCodeAt(i);
                this.say(`${scene.name}: unpacking, ${Math.floor(100 * at / text.length)} %`);
                await new Promise(requestAnimationFrame);
            }
            inlined.remove();
            if (bytes[0] === 0x1f) scene.extension = ".spz";
            return bytes.buffer;
        }
        const answer = await asked(scene.source);
        const all = Number(answer.headers.get("Content-Length")), parts = [];
        let done = 0, next = FIRST;
        for await (const part of chunks(answer.body)) {
            parts.push(part);
            done += part.length;
            if (all) this.arrived(scene, `${sized(done)} of ${sized(all)}`);
            // The server sends the most visible Gaussians first.
            if (index >= 0 && all > PREVIEWED && done >= next * all) {
                next *= 4;
                this.read(index, await new Blob(parts).arrayBuffer(), false);
            }
        }
        return new Blob(parts).arrayBuffer();
    }

    // In the middle until there is a picture.
    arrived(scene, text) {
        scene.arriving = text;
        if (scene === this.scene) scene.drawable ? this.label() : this.say(`${scene.name}: ${text}`);
    }

    failed(index, words) {
        this.scenes[index].failed = words;
        this.scenes[index].done?.();
        if (index === this.current) this.say(`${this.scenes[index].name}: ${words}`, true);
    }

    answered(data) {
        const scene = this.scenes[data.load ?? data.sort];
        if (data.edit !== undefined) return this.edit.answered(data);
        if (data.save !== undefined) return this.edit.saved(data);
        if (data.progress !== undefined) (!scene.drawable || scene.partial) && this.arrived(scene, `reading, ${Math.floor(100 * data.progress)} %`);
        else if (data.failed) this.failed(data.load, data.failed);
        else if (data.gaussians) this.loaded(data.load, data);
        else {
            this.renderer.sort(scene.drawable, data.order);
            scene.late = performance.now() - scene.sorting;
            scene.sorting = false;
            this.views.tellLeftOut();
            this.change();
        }
    }

    loaded(index, data) {
        const scene = this.scenes[index], before = scene.drawable, newest = data.swap === scene.swap;
        try {
            scene.drawable = this.renderer.upload(data);
        } catch (error) {
            return this.failed(index, error.message);
        }
        if (before) this.renderer.release(before);
        Object.assign(scene, { count: data.count, all: data.all, partial: data.count < data.all, sample: data.sample, faint: data.faint, near: data.near, edits: 0, failed: null, sortedFor: data.view }, newest ? scene.next : {});
        if (data.order) this.renderer.sort(scene.drawable, data.order);
        if (newest) scene.done?.();
        if (index === this.current) {
            this.say(data.dropped ? `${counted(data.dropped, "Gaussian")} left out: their values are not finite.` : "");
            if (data.dropped) setTimeout(() => this.say(""), 4000);
        }
        if (!this.home) this.reset();
        if (index === this.current && before) this.tokens.leave();
        if (index === this.current) this.edit.enter();
        this.label();
        this.change();
    }

    // To the first input camera if known.
    reset() {
        const { camera, scene } = this;
        if (!scene?.sample) return;
        const view = firstView(scene.sample);
        if (config.up) camera.up = config.up;
        if (config.cameras?.length) return this.through(0, false);
        camera.fov = view.fov;
        camera.place(view.eye, view.axes, view.distance);
        this.home = true;
        this.overlay.leave();
        this.change();
    }

    through(index, withPhoto = true) {
        const { camera, canvas, scene } = this, all = config.cameras ?? [];
        if (!all.length || !scene?.sample) return;
        this.input = (index + all.length) % all.length;
        const input = all[this.input];
        camera.through(input, canvas.clientWidth, canvas.clientHeight, 1);
        camera.distance = distanceAhead(scene.sample, camera.eye, camera.axes) ?? firstView(scene.sample).distance;
        this.home = true;
        this.overlay.leave();
        if (withPhoto) this.overlay.stand(input);
        this.change();
    }

    change(moving = false) {
        if (moving) {
            this.moved = performance.now();
            this.overlay.leave();
        }
        if (this.waiting) return;
        this.waiting = true;
        requestAnimationFrame(now => this.draw(now));
    }

    draw(now, marked = this.edit.marked) {
        this.waiting = false;
        const moving = now - this.moved < REST, { canvas, camera, scene } = this;
        this.measure(now, moving);
        const ratio = Math.min(devicePixelRatio, 2) * (moving ? this.coarse : 1);
        const [width, height] = [canvas.clientWidth, canvas.clientHeight].map(side => Math.max(1, Math.round(side * ratio)));
        this.order(scene);
        if (!moving) this.overlay.compare(scene);
        this.renderer.resize(width, height, this.views.shown);
        this.renderer.draw(scene?.drawable, camera, this.background, { ...this.views.drawn(), volume: marked });
        this.overlay.draw();
        element("fov").value = camera.fov;
        element("fov-value").textContent = `${Math.round(camera.fov)}°`;
        if (moving) this.change();
    }

    // RGBA bytes, rows from the top. The page needs a redraw afterwards.
    seen(input, width, height) {
        const { renderer, background, scene } = this, camera = new ViewCamera();
        camera.through(input, width, height, 1);
        renderer.resize(width, height);
        renderer.draw(scene.drawable, camera, background);
        return renderer.bytes();
    }

    // After the last answer.
    order(scene) {
        if (!scene?.drawable || scene.sorting) return;
        const view = this.view();
        if (scene.sortedFor?.every((value, i) => value === view[i])) return;
        scene.sorting = performance.now();
        scene.sortedFor = view;
        this.worker.postMessage({ sort: this.current, view });
    }

    pick(x, y) {
        const { canvas, renderer, scene, camera } = this, scale = renderer.frame.width / canvas.clientWidth;
        return renderer.pick(scene?.drawable, camera, Math.floor(x * scale), Math.floor(y * scale));
    }

    view() { return [...this.camera.axes[2], ...this.camera.eye]; }

    measure(now, moving) {
        const { times } = this;
        if (!moving) return void (times.length = 0);
        times.push(now);
        if (times.length > 30) times.shift();
        if (times.length < 6) return;
        const each = (now - times[0]) / (times.length - 1);
        this.rate = 1000 / each;
        if (each > SLOW && this.coarse > 0.25) this.coarse /= 2, times.length = 0;
        else if (each < SLOW / 4 && this.coarse < 1) this.coarse *= 2, times.length = 0;
        this.label();
    }

    label() {
        const { scene, scenes } = this, facts = [];
        element("name").textContent = scene?.name ?? "";
        document.title = scene ? `${scene.name} - ZipSplat` : "ZipSplat";
        if (scene?.partial) facts.push(`${scene.count.toLocaleString("en")} of ${counted(scene.all, "Gaussian")}`, scene.arriving);
        else if (scene?.count) facts.push(counted(scene.count, "Gaussian"));
        if (scene?.bytes && !scene.partial && !scene.edits) facts.push(sized(scene.bytes));
        if (this.rate) facts.push(`${this.rate.toFixed(0)} frames a second`);
        element("facts").textContent = facts.join(" · ");
        element("scenes").hidden = scenes.length < 2;
        element("ratios").hidden = this.current !== this.live.index;
        element("refining").hidden = this.current !== this.refining.index;
        element("scene").max = scenes.length - 1;
        element("scene").value = this.current;
        this.views.tellLeftOut();
        element("scene-label").textContent =
            scene ? `${this.current + 1} of ${scenes.length}: ${[scene.name, ...facts.slice(0, 2)].join(", ")}${config.note ? `. ${config.note}` : ""}` : "";
    }

    add(file) {
        this.scenes.push({ name: file.name, bytes: file.size, file, extension: "" });
        this.choose(this.scenes.length - 1);
    }

    download(name, blob) {
        const link = document.createElement("a");
        link.href = URL.createObjectURL(blob);
        link.download = name;
        link.click();
        setTimeout(() => URL.revokeObjectURL(link.href), 10000);
    }

    // The page clears a shown picture.
    picture() {
        this.moved = 0;
        this.draw(performance.now(), null);
        this.canvas.toBlob(blob => this.download(`${this.stem}.png`, blob));
    }

    buttons() {
        const toggle = id => () => {
            for (const section of document.querySelectorAll("section"))
                section.hidden = section.id !== id || !section.hidden;
            this.edit.enter();
            this.change();
        };
        const full = () => document.fullscreenElement ? document.exitFullscreen() : document.documentElement.requestFullscreen?.();
        const looks = () => element("looks").checked = this.controls.looks = !this.controls.looks;
        const step = by => this.through((this.input ?? (by > 0 ? -1 : 0)) + by);
        const actions = {
            reset: ["KeyR", () => this.reset()], full: ["KeyF", full], save: ["KeyP", () => this.picture()],
            open: ["KeyO", () => element("file").click()], "help-button": ["KeyH", toggle("help")],
            "show-cameras": ["KeyC", () => this.overlay.toggle()],
            previous: ["Comma", () => step(-1)], next: ["Period", () => step(1)], "settings-button": [null, toggle("settings")],
            "path-button": [null, toggle("path")], "edit-button": ["KeyX", toggle("edit")],
        };
        const keys = {
            KeyL: looks, Slash: toggle("help"), KeyK: () => (this.path.keep(), element("path").hidden && toggle("path")()), Space: () => this.path.play(),
            BracketLeft: () => this.choose(this.current - 1), BracketRight: () => this.choose(this.current + 1),
            Escape: toggle(null),
        };
        Object.keys(SHOWN).forEach((shown, i) => keys[`Digit${i + 1}`] = () => this.views.show(shown));
        for (const [id, [key, act]] of Object.entries(actions)) {
            element(id).onclick = act;
            if (key) keys[key] = act;
        }
        addEventListener("keydown", event => {
            if (event.ctrlKey || event.metaKey || event.altKey || event.repeat || !keys[event.code]) return;
            if (event.target.matches?.("input[type=number], select") || event.code === "Space" && event.target.matches?.("button, input")) return;
            event.preventDefault();
            keys[event.code]();
        });
        for (const id of ["previous", "next", "show-cameras"]) element(id).hidden = !config.cameras?.length;
        element("scene").oninput = event => this.choose(Number(event.target.value));
        element("fov").oninput = event => (this.camera.fov = Number(event.target.value), this.change(true));
        element("looks").onchange = event => this.controls.looks = event.target.checked;
        element("background").oninput = event => {
            this.background = [1, 3, 5].map(at => parseInt(event.target.value.slice(at, at + 2), 16) / 255);
            this.change();
        };
        element("file").onchange = event => {
            [...event.target.files].forEach(file => this.add(file));
            event.target.value = "";
        };
        addEventListener("dragover", event => (event.preventDefault(), element("drop").hidden = false));
        addEventListener("dragleave", event => element("drop").hidden ||= event.relatedTarget === null);
        addEventListener("drop", event => {
            event.preventDefault();
            element("drop").hidden = true;
            [...event.dataTransfer.files].forEach(file => this.add(file));
        });
    }
}

async function* chunks(body) {
    const reader = body.getReader();
    for (let part; !(part = await reader.read()).done;) yield part.value;
}

try {
    globalThis.zipsplat = new Page();
} catch (error) {
    element("message").textContent = error.message;
    element("message").classList.add("failed");
    element("message").hidden = false;
}
