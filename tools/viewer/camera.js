// x right, y down, z forward.

const add = (a, b, factor = 1) => a.map((value, i) => value + factor * b[i]);
const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const unit = a => a.map(value => value / Math.hypot(...a));
const median = values => values.sort((a, b) => a - b)[values.length >> 1];

// Radians about a unit axis.
function turned(v, axis, angle) {
    const c = Math.cos(angle), s = Math.sin(angle), along = dot(axis, v) * (1 - c);
    const [x, y, z] = axis;
    const across = [y * v[2] - z * v[1], z * v[0] - x * v[2], x * v[1] - y * v[0]];
    return v.map((value, i) => value * c + across[i] * s + axis[i] * along);
}

const STEEPEST = 0.05; // radians to the vertical

class ViewCamera {
    constructor() {
        this.fov = 50; // degrees, shorter side
        this.up = [0, -1, 0];
        this.place([0, 0, 0], [[1, 0, 0], [0, 1, 0], [0, 0, 1]], 1);
    }

    // Axes: right, down, forward; the orbit center is `distance` ahead. An input camera shifts its
    // slopes and stretches x.
    place(eye, axes, distance) {
        Object.assign(this, { eye: [...eye], axes: axes.map(axis => [...axis]), distance, shift: [0, 0], stretch: 1 });
    }

    focal(width, height) { return Math.min(width, height) / 2 / Math.tan(this.fov * Math.PI / 360); }

    get target() { return add(this.eye, this.axes[2], this.distance); }

    // Yaw about the vertical, pitch about the right axis.
    look(yaw, pitch) {
        const angle = Math.acos(Math.max(-1, Math.min(1, dot(this.axes[2], this.up))));
        const steepest = Math.min(STEEPEST, angle, Math.PI - angle);
        const tilt = Math.max(steepest - angle, Math.min(Math.PI - steepest - angle, -pitch));
        this.axes = this.axes.map(axis => turned(turned(axis, this.axes[0], -tilt), this.up, yaw)).map(unit);
    }

    orbit(yaw, pitch) {
        const target = this.target;
        this.look(yaw, pitch);
        this.eye = add(target, this.axes[2], -this.distance);
    }

    // In multiples of the orbit distance.
    move(right, down, forward) {
        for (const [i, step] of [right, down, forward].entries()) this.eye = add(this.eye, this.axes[i], step * this.distance);
    }

    zoom(factor) {
        const target = this.target;
        this.distance = Math.max(1e-3, this.distance * factor);
        this.eye = add(target, this.axes[2], -this.distance);
    }

    // Fits an input camera into a picture.
    through({ matrix, width, height, fx, fy, cx, cy }, pictureWidth, pictureHeight, distance) {
        const focal = fy * Math.min(pictureWidth / width, pictureHeight / height);
        this.fov = Math.atan(Math.min(pictureWidth, pictureHeight) / 2 / focal) * 360 / Math.PI;
        this.place(matrix.map(row => row[3]), [0, 1, 2].map(i => matrix.slice(0, 3).map(row => row[i])), distance);
        this.shift = [(cx - width / 2) / fx, (cy - height / 2) / fy];
        this.stretch = fx / fy;
    }

    // In pixels from the center, of a point in front.
    project([x, y, z], focal) { return [focal * this.stretch * (x / z + this.shift[0]), focal * (y / z + this.shift[1])]; }

    // Key of nerfstudio's camera_path.json: OpenGL axes, row-major, vertical field of view.
    asKey(width, height) {
        const [right, down, forward] = this.axes;
        const rows = [0, 1, 2].map(i => [right[i], -down[i], -forward[i], this.eye[i]]);
        const fov = 360 / Math.PI * Math.atan(height / 2 / this.focal(width, height));
        return { camera_to_world: [...rows.flat(), 0, 0, 0, 1], fov, aspect: width / height };
    }
}

// None if few points are in view.
function distanceAhead(points, eye, axes) {
    const depths = [], count = points.length / 3;
    for (let i = 0; i < count; ++i) {
        const [x, y, z] = axes.map(axis => dot(axis, add(Array.from(points.subarray(3 * i, 3 * i + 3)), eye, -1)));
        if (z > 0 && Math.abs(x) < 0.7 * z && Math.abs(y) < 0.7 * z) depths.push(z);
    }
    return depths.length > count / 2 ? median(depths) : null;
}

// From the origin, the first photo's camera, if the scene lies ahead, else in front of it.
function firstView(points) {
    const axes = [[1, 0, 0], [0, 1, 0], [0, 0, 1]], ahead = distanceAhead(points, [0, 0, 0], axes);
    const all = Array.from({ length: points.length / 3 }, (_, i) => Array.from(points.subarray(3 * i, 3 * i + 3)));
    if (ahead) {
        const slopes = all.filter(([, , z]) => z > 0).map(([x, y, z]) => Math.max(Math.abs(x), Math.abs(y)) / z).sort((a, b) => a - b);
        const fov = Math.atan(slopes[Math.floor(0.9 * slopes.length)]) * 360 / Math.PI;
        return { eye: [0, 0, 0], axes, distance: ahead, fov: Math.max(20, Math.min(75, fov)) };
    }
    const center = [0, 1, 2].map(c => median(all.map(point => point[c])));
    const distance = 3 * median(all.map(point => Math.hypot(...add(point, center, -1)))) || 1;
    return { eye: add(center, axes[2], -distance), axes, distance, fov: 50 };
}
