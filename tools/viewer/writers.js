// Scene writers: PLY of 3D Gaussian splatting, and SPZ 3. `kept`: numbers of written Gaussians.

const PLY_START = "ply\nformat binary_little_endian 1.0\n";
const LEAST_OPACITY = 1e-6, LEAST_SCALE = 1e-6; // as `zipsplat convert`

function unhalf(bits) {
    const exponent = bits >> 10 & 31, value = exponent ? (1 + (bits & 1023) / 1024) * 2 ** (exponent - 15) : (bits & 1023) * 2 ** -24;
    return bits & 0x8000 ? -value : value;
}

// Cuts rows of a PLY with no other element, with its comments and all properties; else null.
function cutPly(bytes, kept) {
    const { start, count, row } = plyHeader(bytes);
    if (start + count * row !== bytes.length) return null;
    const header = new TextDecoder("latin1").decode(bytes.subarray(0, start));
    const rows = new Uint8Array(row * kept.length);
    kept.forEach((i, at) => rows.set(bytes.subarray(start + i * row, start + (i + 1) * row), at * row));
    return new Blob([Uint8Array.from(header.replace(/(\nelement vertex) \d+/, `$1 ${kept.length}`), c => c.charCodeAt(0)), rows]);
}

function writePly({ degree, antialiased, means, scales, quats, opacities, colors, rest }, kept) {
    const coeffs = (degree + 1) ** 2 - 1, numbered = (name, count) => Array.from({ length: count }, (_, i) => `${name}_${i}`);
    const names = ["x", "y", "z", "nx", "ny", "nz", ...numbered("f_dc", 3), ...numbered("f_rest", 3 * coeffs), "opacity", ...numbered("scale", 3), ...numbered("rot", 4)];
    const header = `${PLY_START}${antialiased ? "comment SplatRenderMode: mip\n" : ""}element vertex ${kept.length}\n` +
        `${names.map(name => `property float ${name}\n`).join("")}end_header\n`;
    const rows = new Float32Array(names.length * kept.length);
    kept.forEach((i, at) => {
        const row = rows.subarray(at * names.length, (at + 1) * names.length);
        const opacity = Math.max(LEAST_OPACITY, Math.min(1 - LEAST_OPACITY, opacities[i]));
        for (let c = 0; c < 3; ++c) {
            row[c] = means[3 * i + c];
            row[6 + c] = (colors[3 * i + c] - 0.5) / SH_0;
            for (let k = 0; k < coeffs; ++k) row[9 + c * coeffs + k] = unhalf(rest[3 * (coeffs * i + k) + c]);
            row[10 + 3 * coeffs + c] = Math.log(Math.max(LEAST_SCALE, scales[3 * i + c]));
        }
        row[9 + 3 * coeffs] = Math.log(opacity / (1 - opacity));
        row.set(quats.subarray(4 * i, 4 * i + 4), 13 + 3 * coeffs);
    });
    return new Blob([header, rows]);
}

// Two bits for the largest of x, y, z, w, then sign and 9-bit magnitude of the others.
function smallestThree(quat) {
    const largest = quat.reduce((best, q, i) => Math.abs(q) > Math.abs(quat[best]) ? i : best, 0);
    return quat.reduce((bits, q, i) => i === largest ? bits :
        bits << 10 | (q < 0 !== quat[largest] < 0) << 9 | Math.min(511, Math.round(511 * Math.SQRT2 * Math.abs(q))), largest);
}

async function writeSpz({ degree, antialiased, means, scales, quats, opacities, colors, rest }, kept) {
    const coeffs = (degree + 1) ** 2 - 1;
    const farthest = kept.reduce((most, i) => Math.max(most, Math.abs(means[3 * i]), Math.abs(means[3 * i + 1]), Math.abs(means[3 * i + 2])), 0);
    const bits = Math.min(16, Math.floor(Math.log2((2 ** 23 - 1) / farthest)));
    if (bits < 0) throw new Error("The scene is too large for an SPZ: it has Gaussians beyond 8,388,607 units.");
    const section = (width, type = Uint8ClampedArray) => new type(width * kept.length);
    const positions = section(9, Uint8Array), alphas = section(1), hues = section(3), sizes = section(3), turns = section(1, Uint32Array), bands = section(3 * coeffs);
    kept.forEach((i, at) => {
        for (let c = 0; c < 3; ++c) {
            const fixed = Math.round((c ? -1 : 1) * means[3 * i + c] * 2 ** bits);
            for (let b = 0; b < 3; ++b) positions[9 * at + 3 * c + b] = fixed >> 8 * b;
            hues[3 * at + c] = 255 * (0.15 * (colors[3 * i + c] - 0.5) / SH_0 + 0.5);
            sizes[3 * at + c] = 16 * (Math.log(scales[3 * i + c]) + 10);
            // Levels are multiples of 8 in degree 1, of 16 in others.
            for (let k = 0, step = 8; k < coeffs; ++k, step = k < 3 ? 8 : 16)
                bands[3 * (coeffs * at + k) + c] = step * Math.floor((Math.round(128 * aboutX(k + 1) * unhalf(rest[3 * (coeffs * i + k) + c])) + 128) / step + 0.5);
        }
        const [w, x, y, z] = quats.subarray(4 * i, 4 * i + 4), length = Math.hypot(w, x, y, z);
        turns[at] = smallestThree([x, -y, -z, w].map(q => q / length));
        alphas[at] = 255 * opacities[i];
    });
    const header = [Uint32Array.of(0x5053474e, 3, kept.length), Uint8Array.of(degree, bits, antialiased, 0)];
    return new Response(new Blob([...header, positions, alphas, hues, sizes, turns, bands]).stream().pipeThrough(new CompressionStream("gzip"))).blob();
}
