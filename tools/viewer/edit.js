// Crop and deletion by a box or sphere with handles, or of a clicked object; undo; saving.

const REACH = 22; // pixels from a handle's center
const AXES = ["#f66", "#6d6", "#69f"];
const FACES = [0, 1, 2].flatMap(axis => [-1, 1].map(side => ({ axis, side })));
const LEAST_SLOPE = 0.3; // limits the speed of handles along the line of sight

class Edit {
    constructor(page) {
        Object.assign(this, { page, volume: null, object: { seeds: [] }, dragged: null });
        const { canvas } = page;
        element("volume").onchange = () => this.reshape();
        element("fit").onclick = () => this.fit();
        element("least").oninput = () => this.reshape();
        for (const act of ["keep", "delete", "undo"]) element(act).onclick = () => this.ask(act);
        element("save-scene").onclick = () => this.save();
        // Before the camera's controls.
        canvas.addEventListener("pointerdown", event => this.grab(event), true);
        canvas.addEventListener("pointermove", event => this.drag(event), true);
        for (const name of ["pointerup", "pointercancel"])
            canvas.addEventListener(name, event => this.dragged?.id === event.pointerId && (this.dragged = null), true);
        canvas.addEventListener("click", event => this.click(event));
        addEventListener("keydown", event => {
            const act = event.code === "Delete" ? "delete" : event.code === "KeyZ" && (event.ctrlKey || event.metaKey) && "undo";
            if (!act || !this.shown || event.target.matches?.("input[type=number]")) return;
            event.preventDefault();
            this.ask(act);
        });
    }

    get shown() { return !element("edit").hidden && this.ready; }

    // A scene that is still arriving is not edited.
    get ready() { return Boolean(this.page.scene?.drawable) && !this.page.scene.partial; }

    get picks() { return this.shown && element("object").selected; }

    get marked() { return this.picks ? this.object : this.shown ? this.volume : null; }

    enter() {
        const { scene } = this.page;
        element("save-scene").disabled = !this.ready || Boolean(this.saved);
        if (!this.ready) {
            for (const act of ["keep", "delete", "undo"]) element(act).disabled = true;
            return;
        }
        if (scene !== this.scene) {
            element("kind").value = /\.spz$/i.test(scene.file?.name ?? scene.extension) ? "spz" : "ply";
            element("object").hidden = element("object").disabled = !scene.features;
            if (!scene.features && element("object").selected) element("volume").value = "box";
            this.object.seeds = [];
        }
        this.scene = scene;
        if (!this.shown) return;
        this.volume ? this.reshape() : this.fit();
    }

    // Around most centers, in view.
    fit() {
        const { sample } = this.page.scene, ends = [0, 1, 2].map(axis => {
            const values = sample.filter((_, i) => i % 3 === axis).sort();
            return [0.05, 0.95].map(share => values[Math.floor(share * (values.length - 1))]);
        });
        this.volume = { center: ends.map(([low, high]) => (low + high) / 2), half: ends.map(([low, high]) => Math.max((high - low) / 2, 1e-6)) };
        this.reshape();
        this.frame();
    }

    // Steps back until nothing covers a handle. Along an axis they would cover each other.
    frame() {
        const { camera, canvas } = this.page, { center, half } = this.volume;
        const free = ({ seen }) => seen && [-REACH, REACH].every(by => document.elementFromPoint(seen[0] + by, seen[1] + by) === canvas);
        if (camera.axes[2].some(value => Math.abs(value) > 0.95)) camera.orbit(0.45, -0.3);
        let distance = Math.max(...half);
        do camera.place(add(center, camera.axes[2], -(distance *= 1.1)), camera.axes, distance);
        while (!this.handles().every(free) && distance < 1e3 * Math.max(...half));
    }

    reshape() {
        const { volume, picks } = this, round = element("volume").value === "sphere";
        element("fit").hidden = picks;
        element("likeness").hidden = !picks;
        this.object.least = Number(element("least-value").textContent = element("least").value);
        if (round && !volume.round) volume.half.fill([...volume.half].sort((a, b) => a - b)[1]);
        volume.round = round;
        this.moved();
    }

    moved() {
        this.ask();
        this.page.change();
    }

    // Counts, and edits by `act`. The latest count waits for the previous answer.
    ask(act) {
        const { page, marked: volume } = this;
        if (!act && this.waits) return void (this.again = true);
        this.waits = true;
        page.worker.postMessage({ edit: page.current, act, volume });
    }

    answered({ edit, count, faint, inside, edits, sample }) {
        const { page } = this, scene = page.scenes[edit], changed = edits !== scene.edits;
        Object.assign(scene, { count, faint, edits, sample: sample ?? scene.sample });
        if (changed) page.overlay.compared = null;
        if (changed || this.picks) scene.sortedFor = null;
        if (scene === page.scene) {
            element("inside").textContent = `${inside.toLocaleString("en")} of ${counted(count, "Gaussian")} inside`;
            element("keep").disabled = element("delete").disabled = inside === 0 || inside === count;
            element("undo").disabled = !edits;
        }
        if (changed) page.label();
        page.change();
        this.waits = false;
        if (this.again) this.again = false, this.ask();
    }

    get name() { return `${this.page.stem}.${element("kind").value}`; }

    // The file itself where nothing changes.
    save() {
        const { page, name } = this, { scene } = page, file = scene.file ?? scene.blob, kind = element("kind").value;
        const own = scene.file?.name ?? `scene${scene.extension}`;
        if (!scene.edits && own.toLowerCase().endsWith(`.${kind}`)) return page.download(scene.file?.name ?? name, file);
        element("save-scene").disabled = true;
        page.say(`${name}: writing`);
        page.worker.postMessage({ save: page.current, file, name: own, kind });
        this.saved = ({ blob, failed }) => {
            this.saved = null;
            this.enter();
            page.say(failed ?? "", Boolean(failed));
            if (blob) page.download(name, blob);
        };
    }

    // Center first, then faces; null behind the camera.
    handles() {
        const { center, half } = this.volume;
        const faces = FACES.map(({ axis, side }) => ({ axis, side, at: center.map((value, i) => i === axis ? value + side * half[i] : value) }));
        return [{ axis: -1, at: center }, ...faces].map((handle, index) => ({ ...handle, index, seen: this.page.overlay.project(handle.at) }));
    }

    nearest(x, y) {
        if (!this.shown || this.picks) return null;
        const apart = ({ seen }) => seen ? Math.hypot(seen[0] - x, seen[1] - y) : Infinity;
        const handle = this.handles().reduce((best, handle) => apart(handle) < apart(best) ? handle : best);
        return apart(handle) < REACH ? handle : null;
    }

    click(event) {
        if (!this.picks || this.page.overlay.dragged(event)) return;
        const found = this.page.pick(event.clientX, event.clientY), added = event.shiftKey || element("add").checked;
        this.object.seeds = [...added ? this.object.seeds : [], ...found === null ? [] : [found]];
        this.moved();
    }

    grab(event) {
        const handle = this.dragged ? null : this.nearest(event.clientX, event.clientY);
        if (!handle) return;
        event.stopImmediatePropagation();
        this.page.canvas.setPointerCapture(event.pointerId);
        this.dragged = { id: event.pointerId, index: handle.index, at: [event.clientX, event.clientY] };
    }

    drag(event) {
        const { dragged, page } = this;
        if (dragged?.id !== event.pointerId) return void (page.canvas.style.cursor = !event.buttons && this.nearest(event.clientX, event.clientY) ? "move" : "");
        event.stopImmediatePropagation();
        this.move(this.handles()[dragged.index], event.clientX - dragged.at[0], event.clientY - dragged.at[1]);
        dragged.at = [event.clientX, event.clientY];
        this.moved();
    }

    // By pixels: the center in the picture's plane, a face along its axis.
    move({ axis, side, at }, dx, dy) {
        const { camera, canvas } = this.page, { volume } = this, [right, down] = camera.axes;
        const [x, y, z] = camera.axes.map(own => dot(own, add(at, camera.eye, -1))), scale = camera.focal(canvas.clientWidth, canvas.clientHeight) / z;
        if (axis < 0) return void (volume.center = add(add(at, right, dx / scale), down, dy / scale));
        const [u, v, w] = camera.axes.map(own => side * own[axis]), [gx, gy] = [scale * (u - x / z * w), scale * (v - y / z * w)];
        const step = (dx * gx + dy * gy) / Math.max(gx * gx + gy * gy, (LEAST_SLOPE * scale) ** 2);
        const by = Math.max(volume.round ? step : step / 2, -0.95 * volume.half[axis]);
        if (volume.round) return void (volume.half = volume.half.map(half => half + by));
        volume.half[axis] += by;
        volume.center[axis] += side * by;
    }

    draw(context) {
        if (!this.shown || this.picks) return;
        const { volume: { center, half, round }, page: { overlay } } = this;
        const corner = signs => center.map((value, i) => value + signs[i] * half[i]);
        context.lineWidth = 1.5;
        for (const [axis, color] of AXES.entries()) {
            const [a, b] = [(axis + 1) % 3, (axis + 2) % 3], point = (own, one, two) => corner(Object.assign([], { [axis]: own, [a]: one, [b]: two }));
            context.strokeStyle = round ? color : "#fc6";
            context.beginPath();
            if (round) {
                const arc = k => point(0, Math.cos(k * Math.PI / 32), Math.sin(k * Math.PI / 32));
                for (let k = 0; k < 64; ++k) overlay.line(context, arc(k), arc(k + 1));
            } else for (const [one, two] of [[-1, -1], [-1, 1], [1, -1], [1, 1]]) overlay.line(context, point(-1, one, two), point(1, one, two));
            context.stroke();
        }
        context.strokeStyle = "#000";
        for (const { axis, seen } of this.handles()) {
            if (!seen) continue;
            context.fillStyle = AXES[axis] ?? "#fff";
            context.beginPath();
            context.arc(...seen, axis < 0 ? 9 : 7, 0, 2 * Math.PI);
            context.fill();
            context.stroke();
        }
    }
}
