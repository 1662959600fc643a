// Key cameras: playback, camera_path.json, recording.

const FPS = 30;

// Uniform Catmull-Rom between b and c.
function spline(a, b, c, d, t) {
    return b.map((_, i) => b[i] + 0.5 * t * (c[i] - a[i] + t * (2 * a[i] - 5 * b[i] + 4 * c[i] - d[i] + t * (3 * (b[i] - c[i]) + d[i] - a[i]))));
}

// From orthonormal axes, wxyz.
function quaternion([right, down, forward]) {
    const m = (row, column) => [right, down, forward][column][row];
    const q = [1 + m(0, 0) + m(1, 1) + m(2, 2), 1 + m(0, 0) - m(1, 1) - m(2, 2), 1 - m(0, 0) + m(1, 1) - m(2, 2), 1 - m(0, 0) - m(1, 1) + m(2, 2)];
    const largest = q.indexOf(Math.max(...q));
    const [wx, wy, wz] = [m(2, 1) - m(1, 2), m(0, 2) - m(2, 0), m(1, 0) - m(0, 1)];
    const [xy, xz, yz] = [m(0, 1) + m(1, 0), m(0, 2) + m(2, 0), m(1, 2) + m(2, 1)];
    return unit([[q[0], wx, wy, wz], [wx, q[1], xy, xz], [wy, xy, q[2], yz], [wz, xz, yz, q[3]]][largest]);
}

function axesOf([w, x, y, z]) {
    return [
        [1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)],
        [2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)],
        [2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)],
    ];
}

class Path {
    constructor(page) {
        this.page = page;
        this.keys = [];
        element("keep-view").onclick = () => this.keep();
        element("drop-view").onclick = () => (this.keys.pop(), this.changed());
        element("play").onclick = () => this.play();
        element("save-keys").onclick = () => this.save();
        element("record").onclick = () => this.record();
        page.canvas.addEventListener("pointerdown", () => this.playing = null);
    }

    get seconds() { return Math.max(0.1, Math.min(300, Number(element("seconds").value) || 4)); }

    keep() {
        const { eye, axes, fov, distance } = this.page.camera, last = this.keys.at(-1);
        let turn = quaternion(axes);
        // The nearer quaternion takes the short way.
        if (last && last.turn.reduce((sum, value, i) => sum + value * turn[i], 0) < 0) turn = turn.map(value => -value);
        this.keys.push({ eye: [...eye], turn, fov, distance });
        this.changed();
    }

    changed() {
        const count = this.keys.length;
        element("keys").textContent = count ? `${counted(count, "key camera")} kept.` : "No key camera kept yet.";
        for (const id of ["drop-view", "save-keys", "record"]) element(id).disabled = !count;
        element("play").disabled = count < 2;
    }

    at(share) {
        const { keys } = this, place = share * (keys.length - 1), first = Math.min(Math.floor(place), Math.max(0, keys.length - 2));
        const key = i => keys[Math.max(0, Math.min(keys.length - 1, i))];
        const around = [first - 1, first, first + 1, first + 2].map(key), t = place - first;
        const blended = name => spline(...around.map(key => [key[name]].flat()), t);
        const camera = new ViewCamera();
        camera.fov = Math.max(1, Math.min(170, blended("fov")[0]));
        camera.place(blended("eye"), axesOf(unit(blended("turn"))), blended("distance")[0]);
        return camera;
    }

    play() {
        if (this.keys.length < 2) return;
        if (this.playing) return void (this.playing = null);
        const { page } = this, own = this.playing = {}, begin = performance.now();
        const step = now => {
            if (this.playing !== own) return;
            const share = Math.min(1, (now - begin) / 1000 / this.seconds), { eye, axes, distance, fov } = this.at(share);
            page.camera.fov = fov;
            page.camera.place(eye, axes, distance);
            page.change(true);
            if (share < 1) requestAnimationFrame(step);
            else this.playing = null;
        };
        requestAnimationFrame(step);
    }

    file() {
        const { clientWidth: width, clientHeight: height } = this.page.canvas, { keys, seconds } = this;
        const count = keys.length > 1 ? Math.max(2, Math.round(FPS * seconds)) : 1;
        const frames = Array.from({ length: count }, (_, i) => this.at(count > 1 ? i / (count - 1) : 0).asKey(width, height));
        return { camera_type: "perspective", render_width: width, render_height: height, fps: FPS, seconds, camera_path: frames };
    }

    save() {
        const text = JSON.stringify(this.file(), null, 1);
        this.page.download("camera_path.json", new Blob([text], { type: "application/json" }));
    }

    say(text) { element("recorded").textContent = text; }

    // On the server, or shows the command.
    async record() {
        const { page } = this, { scene } = page, format = element("format").value, name = page.stem;
        if (!scene.source || scene.edits) {
            this.save();
            const whole = scene.file && !scene.edits, file = whole ? scene.file.name : page.edit.name;
            const kept = whole ? "" : "the scene, by Edit, and ";
            return this.say(`${scene.source ? "The server has the scene without the edits" : "This page has no zipsplat beside it"}. Save ${kept}the path, which was saved just now, then run: ` +
                `zipsplat render ${quoted(file)} --cameras camera_path.json --fps ${FPS} --video ${quoted(`${name}.${format}`)}`);
        }
        element("record").disabled = true;
        const path = this.file(), pictures = counted(path.camera_path.length, "picture");
        this.say(`Recording ${pictures}`);
        const look = setInterval(async () => {
            const answer = await fetch("recording").then(answer => answer.json()).catch(() => null);
            if (answer && this.recording) this.say(`Recording ${pictures}, ${Math.floor(100 * answer.done)} %`);
        }, 500);
        this.recording = true;
        try {
            const body = JSON.stringify({ scene: scene.source, path, background: page.background, fps: FPS, format });
            const blob = await (await asked("record", { method: "POST", body })).blob();
            page.download(`${name}.${format}`, blob);
            this.say(`Recorded ${pictures}, ${sized(blob.size)}.`);
        } catch (error) {
            this.say(error.message);
        }
        this.recording = false;
        clearInterval(look);
        this.changed();
    }
}

const quoted = name => /^[\w.+-]+$/.test(name) ? name : `'${name.replaceAll("'", "'\\''")}'`;
