// Scene readers: PLY of 3D Gaussian splatting, SPZ 2 to 4, SOG, .splat, glTF with
// KHR_gaussian_splatting. Errors are for the user.
//
// A scene has `count` Gaussians in the engine's axes: means [N, 3], linear scales [N, 3], quats [N,
// 4] wxyz, opacities [N], colors [N, 3] from degree 0, and `rest` [N, K - 1, 3], half floats.
// Opacities of `antialiased` scenes are for blur compensation.

const SH_0 = 0.2820947917738781;

const floats = new Float32Array(1), floatBits = new Uint32Array(floats.buffer);

// Half-float bits. Overflow saturates, underflow becomes 0.
function half(value) {
    floats[0] = value;
    const bits = floatBits[0], sign = bits >>> 16 & 0x8000, magnitude = (bits & 0x7fffffff) + 0x1000;
    if (magnitude >= 0x47800000) return sign | 0x7bff;
    return magnitude < 0x38800000 ? sign : sign | (magnitude - 0x38000000) >>> 13;
}

function emptyScene(count, degree) {
    const scene = { count, degree, antialiased: false };
    for (const [name, width] of [["means", 3], ["scales", 3], ["quats", 4], ["opacities", 1], ["colors", 3]])
        scene[name] = new Float32Array(count * width);
    scene.rest = new Uint16Array(count * 3 * ((degree + 1) ** 2 - 1));
    return scene;
}

const PLY_TYPES = {
    char: [1, "getInt8"], int8: [1, "getInt8"], uchar: [1, "getUint8"], uint8: [1, "getUint8"],
    short: [2, "getInt16"], int16: [2, "getInt16"], ushort: [2, "getUint16"], uint16: [2, "getUint16"],
    int: [4, "getInt32"], int32: [4, "getInt32"], uint: [4, "getUint32"], uint32: [4, "getUint32"],
    float: [4, "getFloat32"], float32: [4, "getFloat32"], double: [8, "getFloat64"], float64: [8, "getFloat64"],
};

// Data offset, count, stride, and properties.
function plyHeader(bytes) {
    const text = new TextDecoder("latin1").decode(bytes.subarray(0, 1 << 16));
    const end = /(^|\n)end_header\r?\n/.exec(text);
    if (!end) throw new Error("The PLY's header has no end: the file is cut off or no PLY.");
    const header = { start: end.index + end[0].length, count: 0, row: 0, properties: new Map(), antialiased: false };
    let element = null;
    for (const line of text.slice(0, end.index).split(/\r?\n/)) {
        const [word, ...rest] = line.trim().split(/\s+/);
        if (word === "format" && rest[0] !== "binary_little_endian")
            throw new Error(`The PLY is ${rest[0]}: this page reads binary_little_endian, which zipsplat convert writes.`);
        // Tags of Brush and Postshot.
        if (word === "comment" && /^(splatrendermode:|antialiased) \S+$/i.test(rest.join(" ")))
            header.antialiased = /^(splatrendermode: mip|antialiased 1)$/i.test(rest.join(" "));
        if (word === "element") {
            if (element === null && rest[0] !== "vertex")
                throw new Error(`The PLY begins with ${rest[0]}s: zipsplat convert makes a PLY that this page reads.`);
            element = rest[0];
            if (element === "vertex") header.count = Number(rest[1]);
        }
        if (word === "property" && element === "vertex") {
            const type = PLY_TYPES[rest[0]];
            if (!type) throw new Error(`The PLY's vertices have a property of type ${rest[0]}, which no Gaussian has.`);
            header.properties.set(rest[1], { at: header.row, read: type[1] });
            header.row += type[0];
        }
    }
    return header;
}

// Reads the rows that are there, of `all`, unless `whole`.
async function readPly(bytes, progress, whole = true) {
    const { start, count: all, row, properties, antialiased } = plyHeader(bytes);
    const count = whole ? all : Math.min(all, Math.floor((bytes.length - start) / row));
    const names = ["x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity", "scale_0", "scale_1", "scale_2",
        "rot_0", "rot_1", "rot_2", "rot_3"];
    const missing = names.filter(name => !properties.has(name));
    if (missing.length) throw new Error(`The PLY has no ${missing.join(", ")}: it holds no 3D Gaussians.`);
    if (!(count >= 0 && start + count * row <= bytes.length))
        throw new Error(`The PLY is cut off: ${count} Gaussians take ${start + count * row} bytes, it has ${bytes.length}.`);
    let perChannel = 0;
    while (properties.has(`f_rest_${3 * perChannel}`)) ++perChannel;
    const degree = [0, 3, 8, 15].indexOf(perChannel);
    if (degree < 0) throw new Error(`The PLY has ${3 * perChannel} coefficients f_rest, where 0, 9, 24 or 45 are usual.`);
    const view = new DataView(bytes.buffer, bytes.byteOffset), columns = [...properties.values()];
    // For float-only files.
    const values = columns.every(({ read }) => read === "getFloat32") && new Float32Array(bytes.slice(start, start + count * row).buffer);
    const reader = name => {
        const { at, read } = properties.get(name);
        if (values) return i => values[(i * row + at) / 4];
        return i => view[read](start + i * row + at, true);
    };
    const [x, y, z, r, g, b, opacity, s0, s1, s2, ...rot] = names.map(reader);
    const rest = Array.from({ length: 3 * perChannel }, (_, j) => reader(`f_rest_${j % 3 * perChannel + Math.floor(j / 3)}`));
    const scene = { ...emptyScene(count, degree), all, antialiased }, fields = [[scene.means, [x, y, z]], [scene.quats, rot]];
    for (let i = 0; i < count; ++i) {
        for (const [field, readers] of fields)
            for (let j = 0; j < readers.length; ++j) field[i * readers.length + j] = readers[j](i);
        scene.colors.set([0.5 + SH_0 * r(i), 0.5 + SH_0 * g(i), 0.5 + SH_0 * b(i)], 3 * i);
        scene.scales.set([Math.exp(s0(i)), Math.exp(s1(i)), Math.exp(s2(i))], 3 * i);
        scene.opacities[i] = 1 / (1 + Math.exp(-opacity(i)));
        for (let j = 0; j < rest.length; ++j) scene.rest[i * rest.length + j] = half(rest[j](i));
        if (i % 65536 === 0) await progress(i / count);
    }
    return scene;
}

// Factor of coefficient k under a half turn about x.
function aboutX(k) {
    const l = Math.floor(Math.sqrt(k)), order = Math.abs(k - l * (l + 1)), negative = k < l * (l + 1);
    return negative !== ((l + order) % 2 === 1) ? -1 : 1;
}

async function unpacked(bytes, method, format) {
    try {
        return new Uint8Array(await new Response(new Blob([bytes]).stream().pipeThrough(new DecompressionStream(method))).arrayBuffer());
    } catch {
        throw new Error(`The ${format} is damaged or cut off: it cannot be unpacked.`);
    }
}

// Header and attributes as in version 3; version 4 has zstd frames.
function readSpz4(bytes) {
    const view = new DataView(bytes.buffer, bytes.byteOffset, bytes.byteLength), parts = [bytes.subarray(0, 16)];
    try {
        const table = view.getUint32(16, true);
        for (let i = 0, at = table + 16 * bytes[15]; i < bytes[15]; ++i) {
            const [packed, plain] = [0, 8].map(half => Number(view.getBigUint64(table + 16 * i + half, true)));
            if (plain) parts.push(unzstd(bytes.subarray(at, at + packed), plain));
            at += packed;
        }
    } catch {
        throw new Error("The SPZ is damaged or cut off: it cannot be unpacked.");
    }
    const whole = new Uint8Array(parts.reduce((sum, part) => sum + part.length, 0));
    parts.reduce((at, part) => (whole.set(part, at), at + part.length), 0);
    return whole;
}

// Refuses extension records with other axes than right, up, back.
function checkAxes(records) {
    const view = new DataView(records.buffer, records.byteOffset, records.byteLength);
    for (let at = 0; at + 12 <= records.length; at += 8 + view.getUint32(at + 4, true))
        if (view.getUint32(at, true) === 0xadbe0003 && ![0, 4].includes(view.getUint32(at + 8, true)))
            throw new Error("The SPZ has other axes than right, up, back: this page does not read them.");
}

async function readSpz(packed, progress) {
    const bytes = packed[0] === 0x1f ? await unpacked(packed, "gzip", "SPZ") : readSpz4(packed);
    progress(0.3);
    const view = new DataView(bytes.buffer);
    if (bytes.length < 16 || view.getUint32(0, true) !== 0x5053474e) throw new Error("The file is packed with gzip and holds no SPZ.");
    const version = view.getUint32(4, true), count = view.getUint32(8, true), degree = bytes[12], one = 2 ** bytes[13];
    if (![2, 3, 4].includes(version)) throw new Error(`The SPZ is of version ${version}: this page reads 2 to 4.`);
    if (degree > 3) throw new Error(`The SPZ has spherical harmonics of degree ${degree}: this page reads 0 to 3.`);
    const rotationBytes = version === 2 ? 3 : 4, rest = 3 * ((degree + 1) ** 2 - 1);
    let end = 16;
    const sections = [9, 1, 3, 3, rotationBytes, rest].map(width => bytes.subarray(end, end += width * count));
    if (end > bytes.length) throw new Error(`The SPZ is cut off: ${count} Gaussians take ${end} bytes, it has ${bytes.length}.`);
    if (bytes[14] & 2) checkAxes(version === 4 ? packed.subarray(32, new DataView(packed.buffer, packed.byteOffset).getUint32(16, true)) : bytes.subarray(end));
    const [positions, alphas, colors, scales, rotations, harmonics] = sections;
    const scene = { ...emptyScene(count, degree), antialiased: Boolean(bytes[14] & 1) }, signs = Array.from({ length: rest / 3 }, (_, k) => aboutX(k + 1));
    const quat = [0, 0, 0, 0];
    for (let i = 0; i < count; ++i) {
        for (let j = 0; j < 3; ++j) {
            const at = 9 * i + 3 * j, c = 3 * i + j;
            const fixed = (positions[at] << 8 | positions[at + 1] << 16 | positions[at + 2] << 24) >> 8;
            scene.means[c] = (j === 0 ? fixed : -fixed) / one;
            scene.colors[c] = 0.5 + SH_0 * (colors[c] / 255 - 0.5) / 0.15;
            scene.scales[c] = Math.exp(scales[c] / 16 - 10);
        }
        scene.opacities[i] = alphas[i] / 255;
        let left = 3; // x, y, z, w
        if (version === 2) for (let j = 0; j < 3; ++j) quat[j] = rotations[3 * i + j] / 127.5 - 1;
        else {
            let bits = rotations[4 * i] | rotations[4 * i + 1] << 8 | rotations[4 * i + 2] << 16 | rotations[4 * i + 3] << 24;
            left = bits >>> 30;
            for (let j = 3; j >= 0; --j) {
                if (j === left) continue;
                quat[j] = (bits & 511) / 511 * Math.SQRT1_2 * (bits >>> 9 & 1 ? -1 : 1);
                bits >>>= 10;
            }
        }
        quat[left] = 0;
        quat[left] = Math.sqrt(Math.max(0, 1 - quat.reduce((sum, q) => sum + q * q, 0)));
        scene.quats.set([quat[3], quat[0], -quat[1], -quat[2]], 4 * i);
        for (let j = 0; j < rest; ++j)
            scene.rest[i * rest + j] = half(signs[Math.floor(j / 3)] * (harmonics[i * rest + j] - 128) / 128);
        if (i % 65536 === 0) await progress(0.3 + 0.7 * i / count);
    }
    return scene;
}

async function readSplat(bytes, progress) {
    if (bytes.length % 32) throw new Error(`The .splat is cut off: ${bytes.length} bytes are no multiple of 32.`);
    const count = bytes.length / 32, scene = emptyScene(count, 0), view = new DataView(bytes.buffer, bytes.byteOffset);
    for (let i = 0; i < count; ++i) {
        for (let j = 0; j < 3; ++j) {
            scene.means[3 * i + j] = view.getFloat32(32 * i + 4 * j, true);
            scene.scales[3 * i + j] = view.getFloat32(32 * i + 12 + 4 * j, true);
            scene.colors[3 * i + j] = bytes[32 * i + 24 + j] / 255;
        }
        scene.opacities[i] = bytes[32 * i + 27] / 255;
        for (let j = 0; j < 4; ++j) scene.quats[4 * i + j] = (bytes[32 * i + 28 + j] - 128) / 128;
        if (i % 65536 === 0) await progress(i / count);
    }
    return scene;
}

// Files of a ZIP archive by name.
async function unzipped(bytes) {
    const view = new DataView(bytes.buffer, bytes.byteOffset, bytes.byteLength), files = new Map();
    let end = bytes.length - 22;
    while (end >= 0 && view.getUint32(end, true) !== 0x06054b50) --end;
    if (end < 0) throw new Error("The SOG is damaged or cut off: it is no ZIP archive.");
    for (let at = view.getUint32(end + 16, true), left = view.getUint16(end + 10, true); left > 0; --left) {
        const start = view.getUint32(at + 42, true), [name, extra, comment] = [28, 30, 32].map(field => view.getUint16(at + field, true));
        const content = start + 30 + view.getUint16(start + 26, true) + view.getUint16(start + 28, true);
        const packed = bytes.subarray(content, content + view.getUint32(at + 20, true));
        const file = view.getUint16(at + 10, true) ? await unpacked(packed, "deflate-raw", "SOG") : packed;
        files.set(new TextDecoder().decode(bytes.subarray(at + 46, at + 46 + name)), file);
        at += 46 + name + extra + comment;
    }
    return files;
}

// RGBA of a picture, by WebGL: a 2D canvas multiplies colors by alpha.
async function texels(bytes) {
    const picture = await createImageBitmap(new Blob([bytes]), { premultiplyAlpha: "none", colorSpaceConversion: "none" });
    const { width, height } = picture, gl = new OffscreenCanvas(1, 1).getContext("webgl2"), texture = gl.createTexture();
    gl.bindTexture(gl.TEXTURE_2D, texture);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA, gl.RGBA, gl.UNSIGNED_BYTE, picture);
    gl.bindFramebuffer(gl.FRAMEBUFFER, gl.createFramebuffer());
    gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, texture, 0);
    const rgba = new Uint8Array(4 * width * height);
    gl.readPixels(0, 0, width, height, gl.RGBA, gl.UNSIGNED_BYTE, rgba);
    gl.getExtension("WEBGL_lose_context")?.loseContext();
    return rgba;
}

// SOG version 2: codes and pixels, a pixel per Gaussian. `decoded` reads RGBA of a picture.
async function readSog(bytes, progress, decoded = texels) {
    const files = await unzipped(bytes);
    const file = name => files.get(name) ?? (() => { throw new Error(`The SOG has no ${name}.`); })();
    const meta = JSON.parse(new TextDecoder().decode(file("meta.json")));
    if (meta.version !== 2) throw new Error(`The SOG is of version ${meta.version}: this page reads 2.`);
    const { count, means, scales, quats, sh0, shN } = meta, degree = shN?.bands ?? 0;
    // The first code of early versions of splat-transform.
    for (const { codebook: c } of [scales, sh0, ...shN ? [shN] : []]) c[0] ??= c[1] + (c[1] - c[255]) / 255;
    const picture = async (name, pixels) => {
        const rgba = await decoded(file(name));
        if (rgba.length < 4 * pixels) throw new Error(`The SOG is cut off: ${name} has ${rgba.length / 4} pixels, expected ${pixels}.`);
        return rgba;
    };
    const of = async names => Promise.all(names.map(name => picture(name, count)));
    const [low, high, sizes, turns, colors] = await of([...means.files, ...scales.files, ...quats.files, ...sh0.files]);
    progress(0.5);
    const scene = { ...emptyScene(count, degree), antialiased: meta.antialias || meta.model === "antialiased" };
    for (let i = 0; i < count; ++i) {
        const quat = [0, 1, 2].map(j => (turns[4 * i + j] / 127.5 - 1) * Math.SQRT1_2);
        quat.splice(turns[4 * i + 3] - 252, 0, Math.sqrt(Math.max(0, 1 - quat.reduce((sum, q) => sum + q * q, 0))));
        scene.quats.set(quat, 4 * i);
        for (let j = 0; j < 3; ++j) {
            const place = (low[4 * i + j] + 256 * high[4 * i + j]) / 65535;
            const log = means.mins[j] + (means.maxs[j] - means.mins[j]) * place;
            scene.means[3 * i + j] = Math.sign(log) * Math.expm1(Math.abs(log));
            scene.scales[3 * i + j] = Math.exp(scales.codebook[sizes[4 * i + j]]);
            scene.colors[3 * i + j] = 0.5 + SH_0 * sh0.codebook[colors[4 * i + j]];
        }
        scene.opacities[i] = colors[4 * i + 3] / 255;
    }
    if (degree === 0) return scene;
    const width = (degree + 1) ** 2 - 1, codes = shN.codebook.map(half), labels = await picture(shN.files[1], count);
    const entries = await picture(shN.files[0], shN.count * width);
    for (let i = 0; i < count; ++i) {
        const entry = labels[4 * i] + 256 * labels[4 * i + 1];
        for (let j = 0; j < 3 * width; ++j) scene.rest[3 * width * i + j] = codes[entries[4 * (entry * width + Math.floor(j / 3)) + j % 3]];
        if (i % 65536 === 0) await progress(0.5 + 0.5 * i / count);
    }
    return scene;
}

const GLTF = "KHR_gaussian_splatting";
const GLTF_TYPES = { 5120: [1, "getInt8", 127], 5121: [1, "getUint8", 255], 5122: [2, "getInt16", 32767], 5123: [2, "getUint16", 65535], 5126: [4, "getFloat32", 1] };

// JSON and buffers, from .glb chunks or base64.
function gltfParts(bytes) {
    const parsed = text => {
        try {
            return JSON.parse(new TextDecoder().decode(text));
        } catch {
            throw new Error("The glTF's JSON is damaged or cut off.");
        }
    };
    const of = (document, chunk) => [document, (document.buffers ?? []).map(({ uri }, i) => {
        if (uri === undefined && i === 0 && chunk) return chunk;
        if (!uri?.startsWith("data:")) throw new Error(`The glTF's numbers are in another file, ${uri}: zipsplat convert makes one file of both.`);
        return Uint8Array.from(atob(uri.slice(uri.indexOf(",") + 1)), c => c.charCodeAt(0));
    })];
    if (bytes[0] !== 0x67) return of(parsed(bytes));
    const view = new DataView(bytes.buffer, bytes.byteOffset);
    if (bytes.length < 20 || view.getUint32(8, true) > bytes.length) throw new Error(`The glTF is cut off: it has ${bytes.length} bytes.`);
    if (view.getUint32(4, true) !== 2) throw new Error(`The glTF is of version ${view.getUint32(4, true)}: this page reads 2.`);
    const end = 20 + view.getUint32(12, true);
    return of(parsed(bytes.subarray(20, end)), end < bytes.length && bytes.subarray(end + 8, end + 8 + view.getUint32(end, true)));
}

// Count, and a reader of component c of element i.
function gltfNumbers({ accessors, bufferViews }, buffers, index, width) {
    const accessor = accessors?.[index], from = bufferViews?.[accessor?.bufferView], type = GLTF_TYPES[accessor?.componentType];
    const shape = ["SCALAR", "VEC2", "VEC3", "VEC4"][width - 1], bytes = buffers[from?.buffer];
    if (!bytes || !type || accessor.type !== shape || accessor.sparse) throw new Error("The glTF has Gaussians in a way that this page does not read: zipsplat convert may.");
    const [size, read, one] = type, stride = from.byteStride ?? size * width, start = (from.byteOffset ?? 0) + (accessor.byteOffset ?? 0);
    const view = new DataView(bytes.buffer, bytes.byteOffset, bytes.byteLength), { count } = accessor;
    if (count && start + (count - 1) * stride + size * width > bytes.length) throw new Error(`The glTF is cut off: its numbers end behind its ${bytes.length} bytes.`);
    const scale = accessor.normalized ? 1 / one : 1;
    return { count, at: (i, c = 0) => Math.max(view[read](start + i * stride + c * size, true) * scale, accessor.normalized ? -1 : -Infinity) };
}

async function readGltf(bytes, progress) {
    const [document, buffers] = gltfParts(bytes), found = [];
    for (const [i, node] of (document.nodes ?? []).entries()) {
        const own = (document.meshes?.[node.mesh]?.primitives ?? []).filter(primitive => primitive.extensions?.[GLTF]);
        const moved = node.matrix || node.translation || node.rotation || node.scale || document.nodes.some(({ children }) => children?.includes(i));
        if (own.length && moved) throw new Error("The glTF moves its Gaussians by nodes: zipsplat convert makes a file of it that this page reads.");
        found.push(...own);
    }
    if (!found.length) throw new Error("The glTF shows no Gaussians (KHR_gaussian_splatting).");
    if (found.length > 1) throw new Error(`The glTF shows ${found.length} clouds of Gaussians: zipsplat convert makes one of them.`);
    const { attributes } = found[0];
    const numbers = (name, width) => {
        if (attributes[name] === undefined) throw new Error(`The glTF's Gaussians have no ${name}.`);
        return gltfNumbers(document, buffers, attributes[name], width);
    };
    const has = degree => attributes[`${GLTF}:SH_DEGREE_${degree}_COEF_0`] !== undefined, degree = [3, 2, 1, 0].find(has) ?? 0;
    const means = numbers("POSITION", 3), scales = numbers(`${GLTF}:SCALE`, 3), quats = numbers(`${GLTF}:ROTATION`, 4);
    const opacities = numbers(`${GLTF}:OPACITY`, 1), bands = [];
    for (let l = 0; l <= degree; ++l)
        for (let m = 0; m <= 2 * l; ++m) bands.push(numbers(`${GLTF}:SH_DEGREE_${l}_COEF_${m}`, 3));
    const { count } = means, scene = emptyScene(count, degree), turn = [-1, -1, 1];
    if ([scales, quats, opacities, ...bands].some(other => other.count !== count)) throw new Error(`The glTF has not ${count} of each number of its Gaussians.`);
    // A half turn about z negates harmonics of odd order.
    const signs = bands.map((_, k) => Math.abs(k - Math.floor(Math.sqrt(k)) * (Math.floor(Math.sqrt(k)) + 1)) % 2 ? -1 : 1);
    for (let i = 0; i < count; ++i) {
        for (let c = 0; c < 3; ++c) {
            scene.means[3 * i + c] = turn[c] * means.at(i, c);
            scene.scales[3 * i + c] = scales.at(i, c);
            scene.quats[4 * i + 1 + c] = turn[c] * quats.at(i, c);
            scene.colors[3 * i + c] = 0.5 + SH_0 * bands[0].at(i, c);
            for (let k = 1; k < bands.length; ++k) scene.rest[3 * ((bands.length - 1) * i + k - 1) + c] = half(signs[k] * bands[k].at(i, c));
        }
        scene.quats[4 * i] = quats.at(i, 3);
        scene.opacities[i] = opacities.at(i);
        if (i % 65536 === 0) await progress(i / count);
    }
    return scene;
}

// By first bytes, a .splat by its name.
async function readScene(bytes, name, progress, whole) {
    const starts = text => [...text].every((c, i) => bytes[i] === c.charCodeAt(0));
    if (!bytes.length) throw new Error("The file is empty.");
    if (starts("ply\n") || starts("ply\r")) return readPly(bytes, progress, whole);
    if (starts("NGSP") || bytes[0] === 0x1f && bytes[1] === 0x8b) return readSpz(bytes, progress);
    if (starts("PK")) return readSog(bytes, progress);
    if (starts("glTF") || /\.gltf$/i.test(name)) return readGltf(bytes, progress);
    if (/\.splat$/i.test(name)) return readSplat(bytes, progress);
    throw new Error("The file is no scene: this page reads PLY, SPZ, SOG, .splat and glTF.");
}
