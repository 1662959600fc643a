// Reads scenes, packs textures, sorts by depth, deletes and saves.
//
// In, with the number of a scene:
//   { load, bytes, name, view, whole, features, swap }: the view's line of sight and eye are
//     optional, and so are the features: channels, and signed bytes of Gaussians or of groups
//   { sort, view }
//   { edit, act, volume }: acts are "keep" and "delete" a volume, and "undo"; none only counts
//   { save, file, name, kind }
// Out:
//   { load, progress } or { load, failed } with a message
//   { load, count, all, degree, antialiased, dropped, faint, near, gaussians, harmonics, sample,
//     order, swap }
//   { sort, order }
//   { edit, count, faint, inside, edits, sample }
//   { save, blob } or { save, failed }

const FAINTEST = 1 / 255; // weaker Gaussians are invisible
const SAMPLE = 4096;
const NEIGHBORS = 8; // that an object spreads through, as `zipsplat select`
const scenes = new Map();
const INVALID = 0xffff; // number of the edit that removes Gaussians with values that are not finite

async function pack(scene, progress) {
    const { count, means, scales, quats, opacities, colors, rest } = scene;
    const gaussians = new Uint32Array(12 * count), values = new Float32Array(gaussians.buffer);
    const snorm = q => Math.round(32767 * q) & 0xffff;
    const gone = new Uint16Array(count); // number of the edit that removes a Gaussian
    let dropped = 0;
    for (let i = 0; i < count; ++i) {
        const [w, x, y, z] = quats.subarray(4 * i, 4 * i + 4), length = Math.hypot(w, x, y, z);
        values.set(means.subarray(3 * i, 3 * i + 3), 12 * i);
        values.set(scales.subarray(3 * i, 3 * i + 3), 12 * i + 4);
        values.set(colors.subarray(3 * i, 3 * i + 3), 12 * i + 8);
        values[12 * i + 3] = opacities[i];
        gaussians[12 * i + 7] = snorm(w / length) | snorm(x / length) << 16;
        gaussians[12 * i + 11] = snorm(y / length) | snorm(z / length) << 16;
        let sum = length > 0 ? opacities[i] : NaN;
        for (let j = 0; j < 12; ++j) if (j !== 7 && j !== 11) sum += values[12 * i + j];
        if (!Number.isFinite(sum)) {
            values.fill(0, 12 * i, 12 * i + 12);
            means.fill(0, 3 * i, 3 * i + 3);
            gone[i] = INVALID;
            ++dropped;
        }
        if (i % 65536 === 0) await progress(1);
    }
    const width = rest.length / count || 0, texels = Math.ceil(width / 8);
    const harmonics = new Uint16Array(8 * texels * count);
    for (let i = 0; i < count; ++i) harmonics.set(rest.subarray(i * width, (i + 1) * width), 8 * texels * i);
    return { gaussians, harmonics: new Uint32Array(harmonics.buffer), gone, dropped };
}

function sampled({ means }, gone, count) {
    const step = Math.max(1, Math.floor(count / SAMPLE)), points = [];
    for (let i = 0, k = 0; i < gone.length; ++i)
        if (!gone[i] && k++ % step === 0) points.push(means[3 * i], means[3 * i + 1], means[3 * i + 2]);
    return new Float32Array(points);
}

const median = values => [...values].sort((a, b) => a - b)[values.length >> 1];

// Near plane: 0.01, less for extents below 0.1, as in zipsplat render.
function nearPlane(sample, scales) {
    const axis = k => sample.filter((_, i) => i % 3 === k), axes = [0, 1, 2].map(axis), center = axes.map(median);
    const distance = median(axes[0].map((_, i) => Math.hypot(...axes.map((values, k) => values[i] - center[k]))));
    const extent = distance || median(scales.slice(0, 3 * SAMPLE).filter((_, i) => i % 3 === 0));
    return extent < 0.1 && extent > 0 ? 0.01 * 2 ** Math.max(Math.floor(Math.log2(extent)), -100) : 0.01;
}

// Sorts and edits take turns with it.
async function load({ load: id, bytes, name, view, whole, features, swap }) {
    const progress = fraction => {
        if (whole) postMessage({ load: id, progress: fraction });
        return new Promise(resolve => setTimeout(resolve));
    };
    const scene = await readScene(new Uint8Array(bytes), name, progress, whole);
    if (!scene.count) throw new Error("The scene has no Gaussians.");
    const { gaussians, harmonics, gone, dropped } = await pack(scene, progress), { count, all = count, degree, antialiased, means, opacities } = scene;
    if (dropped === count) throw new Error("The scene has no Gaussian with finite values.");
    const sample = sampled(scene, gone, count), near = nearPlane(sample, scene.scales);
    scenes.set(id, { means, count, opacities, near, gone, features, edits: 0, depths: new Float32Array(count), indices: new Uint32Array(count) });
    const { faint } = counts(scenes.get(id));
    const order = view && sorted(scenes.get(id), view);
    postMessage({ load: id, count, all, degree, antialiased, dropped, faint, near, gaussians, harmonics, sample, order, view, swap }, [gaussians.buffer, harmonics.buffer]);
}

// k-d tree: the middle of a range splits it along an axis.
function split(means, tree, from, to, axis) {
    if (to - from < 2) return;
    const middle = from + to >> 1, next = (axis + 1) % 3, at = k => means[3 * tree[k] + axis];
    for (let low = from, high = to - 1; low < high;) {
        let i = low, j = high;
        for (const pivot = at(middle); i <= j;) {
            while (at(i) < pivot) ++i;
            while (at(j) > pivot) --j;
            if (i <= j) [tree[i++], tree[j--]] = [tree[j], tree[i]];
        }
        if (j < middle) low = i;
        if (i > middle) high = j;
    }
    split(means, tree, from, middle, next);
    split(means, tree, middle + 1, to, next);
}

// The nearest Gaussians, itself included.
function neighbors({ means, tree }, i) {
    const row = new Uint32Array(NEIGHBORS + 1).fill(i), apart = new Float64Array(row.length).fill(Infinity);
    const visit = (from, to, axis) => {
        if (from >= to) return;
        const middle = from + to >> 1, away = c => means[3 * i + c] - means[3 * tree[middle] + c];
        const squared = away(0) ** 2 + away(1) ** 2 + away(2) ** 2, below = away(axis) < 0, next = (axis + 1) % 3;
        if (squared < apart[NEIGHBORS]) {
            let k = NEIGHBORS;
            for (; k && apart[k - 1] > squared; --k) apart[k] = apart[k - 1], row[k] = row[k - 1];
            apart[k] = squared;
            row[k] = tree[middle];
        }
        visit(below ? from : middle + 1, below ? middle : to, next);
        if (away(axis) ** 2 < apart[NEIGHBORS]) visit(below ? middle + 1 : from, below ? to : middle, next);
    };
    visit(0, tree.length, 0);
    return row;
}

// Marks with 1 the Gaussians like the seeds' mean that neighbors of the kind connect with a seed.
function object(scene, { seeds, least }) {
    const { means, count, gone, features: { values, channels } } = scene, marks = new Uint8Array(count), open = [];
    const mean = new Float64Array(channels), near = scene.neighbors ??= new Array(count), row = i => channels * Math.floor(i * values.length / channels / count);
    const product = (at, other, from) => {
        let sum = 0;
        for (let c = 0; c < channels; ++c) sum += values[at + c] * other[from + c];
        return sum;
    };
    const size = at => Math.sqrt(product(at, values, at));
    const reach = i => marks[i] ||= !gone[i] && product(row(i), mean, 0) / size(row(i)) >= least * length && open.push(i) ? 1 : 2;
    if (!scene.tree) split(means, scene.tree = new Uint32Array(count).map((_, i) => i), 0, count, 0);
    for (const at of seeds.map(row)) mean.forEach((_, c) => mean[c] += values[at + c] / (size(at) || 1));
    const length = Math.hypot(...mean);
    seeds.forEach(reach);
    for (let i; (i = open.pop()) !== undefined;) (near[i] ??= neighbors(scene, i)).forEach(reach);
    return marks;
}

// Whether a volume has a Gaussian: an object by its seeds; a box, or an ellipsoid if `round`, by
// its center and half its size.
function within(scene, volume) {
    const { means } = scene, { center, half, round } = volume, marks = volume.seeds && (scene.marks = object(scene, volume));
    return marks ? i => marks[i] === 1 : i => {
        const x = (means[3 * i] - center[0]) / half[0], y = (means[3 * i + 1] - center[1]) / half[1], z = (means[3 * i + 2] - center[2]) / half[2];
        return round ? x * x + y * y + z * z <= 1 : Math.max(Math.abs(x), Math.abs(y), Math.abs(z)) <= 1;
    };
}

function counts(scene, volume) {
    const { opacities, gone, edits } = scene, holds = volume ? within(scene, volume) : () => false;
    let count = 0, faint = 0, inside = 0;
    for (let i = 0; i < gone.length; ++i) {
        if (gone[i]) continue;
        ++count;
        faint += !(opacities[i] >= FAINTEST);
        inside += holds(i);
    }
    return { count, faint, inside, edits };
}

// Edits that would leave none or all are refused.
function edit(scene, act, volume) {
    const before = counts(scene, volume), { gone } = scene, { count, inside } = before, removed = act === "keep" ? count - inside : inside;
    if (!act) return before;
    if (act === "undo") {
        for (let i = 0; i < gone.length; ++i) if (gone[i] === scene.edits) gone[i] = 0;
        scene.edits = Math.max(0, scene.edits - 1);
    } else if (removed > 0 && removed < count) {
        const holds = within(scene, volume);
        ++scene.edits;
        for (let i = 0; i < gone.length; ++i) if (!gone[i] && holds(i) === (act === "delete")) gone[i] = scene.edits;
    }
    const after = counts(scene, volume);
    return { ...after, sample: sampled(scene, gone, after.count) };
}

async function save({ gone }, file, name, kind) {
    const bytes = new Uint8Array(await file.arrayBuffer()), kept = Array.from(gone.keys()).filter(i => !gone[i]);
    const cut = kind === "ply" && String.fromCharCode(...bytes.subarray(0, 3)) === "ply" && cutPly(bytes, kept);
    return cut || (kind === "ply" ? writePly : writeSpz)(await readScene(bytes, name, () => {}), kept);
}

const digits = [new Uint32Array(65536), new Uint32Array(65536)];

// Visible Gaussians beyond the near plane, far to near: a stable radix sort. The highest bit marks
// the object.
function sorted({ means, count, opacities, near, gone, marks, depths, indices }, [fx, fy, fz, ex, ey, ez]) {
    const bits = new Uint32Array(depths.buffer), [low, high] = digits;
    low.fill(0);
    high.fill(0);
    let seen = 0;
    for (let i = 0; i < count; ++i) {
        const depth = (means[3 * i] - ex) * fx + (means[3 * i + 1] - ey) * fy + (means[3 * i + 2] - ez) * fz;
        depths[i] = opacities[i] >= FAINTEST && !gone[i] ? depth : 0;
        if (!(depths[i] >= near)) continue;
        ++low[bits[i] & 0xffff];
        ++high[bits[i] >>> 16];
        ++seen;
    }
    for (const digit of digits) for (let i = 0, sum = 0; i < 65536; ++i) sum += digit[i], digit[i] = sum - digit[i];
    for (let i = 0; i < count; ++i) if (depths[i] >= near) indices[low[bits[i] & 0xffff]++] = i;
    const order = new Uint32Array(seen);
    for (let k = 0; k < seen; ++k) order[seen - 1 - high[bits[indices[k]] >>> 16]++] = indices[k] | (marks?.[indices[k]] === 1) << 31;
    return order;
}

let loads = Promise.resolve();
const newest = new Map();

onmessage = async ({ data }) => {
    if (data.sort !== undefined) {
        const order = sorted(scenes.get(data.sort), data.view);
        postMessage({ sort: data.sort, order }, [order.buffer]);
    } else if (data.edit !== undefined) {
        postMessage({ edit: data.edit, ...edit(scenes.get(data.edit), data.act, data.volume) });
    } else if (data.save !== undefined) {
        const failed = error => postMessage({ save: data.save, failed: error.message });
        await save(scenes.get(data.save), data.file, data.name, data.kind).then(blob => postMessage({ save: data.save, blob }), failed);
    } else {
        newest.set(data.load, data);
        // An overtaken part shows nothing new, unless it is the first.
        const overtaken = () => !data.whole && scenes.has(data.load) && newest.get(data.load) !== data;
        loads = loads.then(() => overtaken() || load(data)).catch(error => {
            const words = error instanceof RangeError ? "The scene is larger than this browser's memory." : error.message;
            postMessage({ load: data.load, failed: words });
        });
    }
};
