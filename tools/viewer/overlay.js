// Input cameras, the edited volume, and the camera's photo with its PSNR.

const MOST_PIXELS = 1 << 20; // in a compared photo

class Overlay {
    constructor(page) {
        this.page = page;
        this.canvas = element("cameras");
        this.shown = false;
        this.photo = element("photo");
        element("wiper").oninput = () => this.wipe();
        page.canvas.addEventListener("click", event => this.pick(event));
        page.canvas.addEventListener("pointerdown", event => this.pressed = [event.clientX, event.clientY]);
    }

    toggle() {
        this.shown = !this.shown && Boolean(config.cameras?.length);
        this.page.change();
    }

    stand(input) {
        if (!input.photo) return;
        this.input = input;
        this.compared = null;
        element("photo-label").textContent = "";
        this.photo.src = input.photo;
        this.photo.onload = () => this.page.change();
        this.photo.hidden = element("photos").hidden = false;
        this.wipe();
    }

    compare(scene) {
        const { page, photo } = this, { naturalWidth, naturalHeight } = photo;
        if (photo.hidden || !photo.complete || !naturalWidth || !scene?.drawable || scene.sorting || this.compared === scene.drawable) return;
        this.compared = scene.drawable;
        const shrink = Math.min(1, Math.sqrt(MOST_PIXELS / naturalWidth / naturalHeight));
        const [width, height] = [naturalWidth, naturalHeight].map(side => Math.max(1, Math.round(side * shrink)));
        const context = Object.assign(document.createElement("canvas"), { width, height }).getContext("2d", { willReadFrequently: true });
        context.drawImage(photo, 0, 0, width, height);
        const truth = context.getImageData(0, 0, width, height).data, drawn = page.seen(this.input, width, height);
        let sum = 0;
        for (let i = 0; i < truth.length; ++i) if (i % 4 < 3) sum += (truth[i] - drawn[i]) ** 2;
        const psnr = 10 * Math.log10(255 ** 2 * 3 * width * height / Math.max(sum, 1e-9));
        element("photo-label").textContent = `${psnr.toFixed(2)} dB, ${width} x ${height}`;
    }

    leave() { this.photo.hidden = element("photos").hidden = true; }

    wipe() { this.photo.style.clipPath = `inset(0 ${100 - element("wiper").value}% 0 0)`; }

    project(point) {
        const { camera, canvas } = this.page, focal = camera.focal(canvas.clientWidth, canvas.clientHeight);
        const seen = camera.axes.map(axis => dot(axis, add(point, camera.eye, -1)));
        if (!(seen[2] > (this.page.scene?.near ?? 0.01))) return null;
        const [x, y] = camera.project(seen, focal);
        return [x + canvas.clientWidth / 2, y + canvas.clientHeight / 2];
    }

    // Center and picture corners, at a share of the scene's distance.
    frustum({ matrix, width, height, fx, fy, cx, cy }) {
        const size = 0.08 * this.page.camera.distance, eye = matrix.slice(0, 3).map(row => row[3]);
        const corner = (u, v) => matrix.slice(0, 3).map(row =>
            row[3] + size * (row[0] * (u - cx) / fx + row[1] * (v - cy) / fy + row[2]));
        return [eye, corner(0, 0), corner(width, 0), corner(width, height), corner(0, height)];
    }

    draw() {
        const { canvas, shown, page } = this, context = canvas.getContext("2d");
        if (!shown && !page.edit.shown) return void (canvas.width = 0);
        canvas.width = devicePixelRatio * canvas.clientWidth;
        canvas.height = devicePixelRatio * canvas.clientHeight;
        context.scale(devicePixelRatio, devicePixelRatio);
        for (const [i, camera] of shown ? config.cameras.entries() : []) {
            const [eye, ...corners] = this.frustum(camera);
            context.strokeStyle = i === page.input ? "#fc6" : "#7cf";
            context.beginPath();
            for (const [k, corner] of corners.entries())
                for (const [from, to] of [[eye, corner], [corner, corners[(k + 1) % 4]]])
                    this.line(context, from, to);
            context.stroke();
        }
        page.edit.draw(context);
    }

    // Between points, in front of the camera.
    line(context, ...ends) {
        const { camera, scene } = this.page, near = 1.001 * (scene?.near ?? 0.01);
        const depths = ends.map(end => dot(camera.axes[2], add(end, camera.eye, -1)) - near);
        if (depths[0] < 0 && depths[1] < 0) return;
        const clip = (end, i) => depths[i] < 0 ? add(end, add(ends[1 - i], end, -1), depths[i] / (depths[i] - depths[1 - i])) : end;
        const [from, to] = ends.map(clip).map(end => this.project(end));
        if (!from || !to) return;
        context.moveTo(...from);
        context.lineTo(...to);
    }

    dragged({ clientX, clientY }) { return Math.hypot(clientX - this.pressed?.[0], clientY - this.pressed?.[1]) > 4; }

    pick(event) {
        if (!this.shown || this.page.edit.picks || this.dragged(event)) return;
        const { clientX, clientY } = event;
        const apart = config.cameras.map(camera => {
            const points = this.frustum(camera).map(point => this.project(point)).filter(Boolean);
            return Math.min(...points.map(([x, y]) => Math.hypot(x - clientX, y - clientY)));
        });
        const nearest = Math.min(...apart);
        if (nearest < 24) this.page.through(apart.indexOf(nearest));
    }
}
