// Mouse, touch and keys. `changed` runs after each movement.

const TURN = 0.005; // radians per pixel
const TAP = 1 / 30; // seconds per key press
const FLY = { KeyW: [0, 0, 1], KeyS: [0, 0, -1], KeyA: [-1, 0, 0], KeyD: [1, 0, 0], KeyQ: [0, 1, 0], KeyE: [0, -1, 0] };
const TURNS = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };

class Controls {
    constructor(canvas, camera, changed) {
        Object.assign(this, { canvas, camera, changed, looks: false });
        this.pointers = new Map();
        this.keys = new Set();
        canvas.addEventListener("pointerdown", event => {
            canvas.setPointerCapture(event.pointerId);
            this.pointers.set(event.pointerId, [event.clientX, event.clientY]);
        });
        for (const name of ["pointerup", "pointercancel"])
            canvas.addEventListener(name, event => this.pointers.delete(event.pointerId));
        canvas.addEventListener("pointermove", event => this.drag(event));
        canvas.addEventListener("contextmenu", event => event.preventDefault());
        canvas.addEventListener("wheel", event => {
            event.preventDefault();
            const lines = event.deltaMode === 1 ? 16 : 1;
            camera.zoom(Math.exp(Math.max(-0.5, Math.min(0.5, 0.0015 * lines * event.deltaY))));
            changed();
        }, { passive: false });
        addEventListener("keydown", event => {
            const typing = event.ctrlKey || event.metaKey || event.altKey || event.target.matches?.("input:not([type=range])");
            if (typing || !(event.code in FLY || event.code in TURNS)) return;
            if (event.target.matches?.("input") && event.code in TURNS) return;
            event.preventDefault();
            const first = !this.keys.size;
            this.keys.add(event.code);
            if (first) this.start();
        });
        addEventListener("keyup", event => this.keys.delete(event.code));
        addEventListener("blur", () => this.keys.clear());
    }

    // Moves points at the orbit distance by the panned pixels.
    pan(dx, dy) {
        const { camera, canvas } = this, focal = camera.focal(canvas.clientWidth, canvas.clientHeight);
        camera.move(-dx / focal, -dy / focal, 0);
    }

    turn(yaw, pitch) { this.looks ? this.camera.look(-yaw, -pitch) : this.camera.orbit(yaw, pitch); }

    drag(event) {
        const from = this.pointers.get(event.pointerId);
        if (!from) return;
        const to = [event.clientX, event.clientY], [dx, dy] = [to[0] - from[0], to[1] - from[1]];
        const other = [...this.pointers].find(([id]) => id !== event.pointerId)?.[1];
        this.pointers.set(event.pointerId, to);
        if (other) {
            const apart = point => Math.hypot(point[0] - other[0], point[1] - other[1]) || 1;
            this.camera.zoom(apart(from) / apart(to));
            this.pan(dx / 2, dy / 2);
        } else if (event.shiftKey || event.buttons & 6) this.pan(dx, dy);
        else this.turn(-TURN * dx * this.handed, -TURN * dy);
        this.changed();
    }

    // Dragging right turns the scene right, also upside down.
    get handed() { return dot(this.camera.axes[1], this.camera.up) > 0 ? -1 : 1; }

    start() {
        let last = performance.now();
        const step = now => {
            if (!this.keys.size) return;
            this.hold(Math.min(0.1, (now - last) / 1000));
            last = now;
            requestAnimationFrame(step);
        };
        this.hold(TAP);
        requestAnimationFrame(step);
    }

    hold(seconds) {
        for (const key of this.keys) {
            if (FLY[key]) this.camera.move(...FLY[key].map(direction => 0.6 * seconds * direction));
            else this.turn(...TURNS[key].map(direction => 1.2 * seconds * direction));
        }
        this.changed();
    }
}
