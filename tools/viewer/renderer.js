// WebGL2 renderer with the rules of kernels/render: EWA splatting with equal blur and cut-offs, far
// to near, half-precision channels, truncated to 8 bits.

const TEXTURE_WIDTH = 4096;

// As --depth, --normals and --gaussians-per-token of `zipsplat render`.
const SHOWN = { color: 0, depth: 1, normals: 2, tokens: 3 };
// Near to far.
const PALETTE = [[1, 0.95, 0.65], [0.98, 0.62, 0.25], [0.8, 0.25, 0.42], [0.4, 0.13, 0.5], [0.08, 0.07, 0.25]];

// Instances are costly.
const BATCH = 128;
// Three texels per projected Gaussian: center and long axis; short axis, number, opacity; color.
const PROJECTED = ["ellipses", "short_axes", "colors"];

const TEXELS = `
ivec2 place_of(uint at) { return ivec2(at % ${TEXTURE_WIDTH}u, at / ${TEXTURE_WIDTH}u); }
uvec4 texel(usampler2D source, uint at) { return texelFetch(source, place_of(at), 0); }
`;

// Projects once for four corners. Invisible Gaussians get opacity 0.
const PROJECT_FRAGMENT = `#version 300 es
precision highp float;
precision highp int;
precision highp usampler2D;
uniform usampler2D order; // the highest bit marks an object
uniform uint drawn;
uniform usampler2D gaussians; // 3 texels each: mean and opacity; scale and q.wx; color and q.yz
uniform usampler2D harmonics;
uniform mat3 view;
uniform vec3 eye;
uniform vec2 focal, shift, size;
uniform float near;
uniform bool antialiased;
uniform int degree, show, hovered; // the token that is pointed at; -1: none
uniform uint group; // Gaussians of a token
uniform int volume; // marked centers: 0 none, 1 in a box, 2 in an ellipsoid, 3 by the order
uniform vec3 middle, reach; // of the volume: center and half its size
layout(location = 0) out uvec4 ellipse;
layout(location = 1) out uvec4 short_axis;
layout(location = 2) out uvec4 color;

const float BLUR = 0.3, ALPHA_MIN = 1.0 / 255.0, SCALE_MAX = 1e8;

${TEXELS}
mat3 rotation(vec4 q) {
    q = normalize(q);
    float w = q.x, x = q.y, y = q.z, z = q.w;
    return mat3(1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + w * z), 2.0 * (x * z - w * y),
        2.0 * (x * y - w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z + w * x),
        2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y));
}

vec3 bands(uint index, vec3 d) {
    float basis[15];
    basis[0] = -0.48860251190292 * d.y;
    basis[1] = 0.48860251190292 * d.z;
    basis[2] = -0.48860251190292 * d.x;
    float zz = d.z * d.z, cos2 = d.x * d.x - d.y * d.y, sin2 = 2.0 * d.x * d.y;
    basis[3] = 0.5462742152960395 * sin2;
    basis[4] = -1.092548430592079 * d.y * d.z;
    basis[5] = 0.9461746957575601 * zz - 0.3153915652525201;
    basis[6] = -1.092548430592079 * d.x * d.z;
    basis[7] = 0.5462742152960395 * cos2;
    float ring = 0.4570457994644658 - 2.285228997322329 * zz;
    basis[8] = -0.5900435899266435 * (d.x * sin2 + d.y * cos2);
    basis[9] = 1.445305721320277 * d.z * sin2;
    basis[10] = ring * d.y;
    basis[11] = d.z * (1.865881662950577 * zz - 1.119528997770346);
    basis[12] = ring * d.x;
    basis[13] = 1.445305721320277 * d.z * cos2;
    basis[14] = -0.5900435899266435 * (d.x * cos2 - d.y * sin2);
    int count = 3 * ((degree + 1) * (degree + 1) - 1), texels = (count + 7) / 8;
    vec3 sum = vec3(0);
    for (int t = 0; t < texels; ++t) {
        uvec4 words = texel(harmonics, index * uint(texels) + uint(t));
        for (int j = 0; j < 8 && 8 * t + j < count; ++j) {
            vec2 pair = unpackHalf2x16(words[j / 2]);
            sum[(8 * t + j) % 3] += basis[(8 * t + j) / 3] * pair[j % 2];
        }
    }
    return sum;
}

// A byte a channel of the PCG hash (Jarzynski and Olano, Hash Functions for GPU Rendering, 2020).
vec3 token_color(uint token) {
    uint state = token * 747796405u + 2891336453u;
    uint word = (state >> ((state >> 28) + 4u) ^ state) * 277803737u, hash = word >> 22 ^ word;
    return vec3(uvec3(hash, hash >> 8, hash >> 16) & 255u) / 255.0;
}

vec3 normal(mat3 axes, vec3 scale, vec3 offset) {
    vec3 axis = scale.x <= min(scale.y, scale.z) ? axes[0] : scale.y <= scale.z ? axes[1] : axes[2];
    return dot(axis, offset) > 0.0 ? -axis : axis;
}

void main() {
    ellipse = short_axis = color = uvec4(0);
    uint slot = uint(gl_FragCoord.y) * ${TEXTURE_WIDTH}u + uint(gl_FragCoord.x);
    if (slot >= drawn) return;
    uint entry = texel(order, slot).x, index = entry & 0x7fffffffu;
    uvec4 first = texel(gaussians, 3u * index), second = texel(gaussians, 3u * index + 1u), third = texel(gaussians, 3u * index + 2u);
    vec3 offset = uintBitsToFloat(first.xyz) - eye, p = view * offset;
    float opacity = uintBitsToFloat(first.w);
    if (!(p.z >= near && opacity >= ALPHA_MIN)) return;

    vec2 half_size = 0.5 * size, limit = half_size / focal * 1.3;
    vec2 slope = clamp(p.xy / p.z, -limit - shift, limit - shift);
    mat3 turn = rotation(vec4(unpackSnorm2x16(second.w), unpackSnorm2x16(third.w))), rows = transpose(view * turn);
    vec3 scale = min(uintBitsToFloat(second.xyz), SCALE_MAX * p.z / focal.x);
    vec3 u = focal.x / p.z * (rows[0] - slope.x * rows[2]) * scale;
    vec3 v = focal.y / p.z * (rows[1] - slope.y * rows[2]) * scale;

    // The determinant as a sum of squares, which does not cancel for needles.
    vec3 minors = cross(u, v);
    float det = dot(minors, minors) + BLUR * (dot(u, u) + dot(v, v)) + BLUR * BLUR;
    if (antialiased) opacity *= sqrt(dot(minors, minors) / det);
    if (opacity < ALPHA_MIN) return;
    float xx = dot(u, u) + BLUR, xy = dot(u, v), yy = dot(v, v) + BLUR;
    float extent = 2.0 * log(255.0 * opacity);
    vec2 center = focal * (p.xy / p.z + shift) + half_size, radii = sqrt(extent * vec2(xx, yy));
    if (any(lessThan(center + radii, vec2(0))) || any(greaterThan(center - radii, size))) return;

    float tilt = 0.5 * (xx - yy), spread = length(vec2(tilt, xy)), longest = 0.5 * (xx + yy) + spread;
    vec2 axis = tilt >= 0.0 ? vec2(tilt + spread, xy) : vec2(xy, spread - tilt);
    axis = spread > 0.0 ? normalize(axis) : vec2(1, 0);
    ellipse = floatBitsToUint(vec4(center, sqrt(longest) * axis));
    short_axis = uvec4(floatBitsToUint(sqrt(det / longest) * vec2(-axis.y, axis.x)), index, floatBitsToUint(opacity));

    vec3 value = uintBitsToFloat(third.xyz);
    if (show == 1) value = vec3(p.z);
    else if (show == 2) value = normal(turn, uintBitsToFloat(second.xyz), offset);
    else if (show == 3) value = uint(hovered) == index / group ? vec3(1) : token_color(index / group) * (hovered < 0 ? 1.0 : 0.45);
    else value = max(degree > 0 ? value + bands(index, normalize(offset)) : value, 0.0);
    vec3 place = abs(uintBitsToFloat(first.xyz) - middle) / reach;
    bool marked = volume == 1 ? max(max(place.x, place.y), place.z) <= 1.0 : volume == 2 ? dot(place, place) <= 1.0 : volume == 3 && entry != index;
    if (marked && show == 0) value = mix(value, vec3(1.0, 0.2, 0.7), volume == 3 ? 0.5 : 0.3);
    color = floatBitsToUint(vec4(value, 0));
}`;

const SPLAT_VERTEX = `#version 300 es
precision highp float;
precision highp int;
precision highp usampler2D;
uniform usampler2D ellipses, short_axes, colors;
uniform uint drawn;
uniform vec2 size;
out vec2 place; // in standard deviations from the center
flat out vec4 color;
flat out uint gaussian;
${TEXELS}
void main() {
    gl_Position = vec4(2, 2, 2, 1); // outside
    uint slot = uint(gl_InstanceID) * ${BATCH}u + uint(gl_VertexID >> 2);
    if (slot >= drawn) return;
    uvec4 second = texel(short_axes, slot);
    float opacity = uintBitsToFloat(second.w);
    if (opacity == 0.0) return;
    vec4 first = uintBitsToFloat(texel(ellipses, slot));
    color = vec4(uintBitsToFloat(texel(colors, slot).xyz), opacity);
    gaussian = second.z;
    place = (vec2(gl_VertexID & 1, gl_VertexID >> 1 & 1) * 2.0 - 1.0) * sqrt(2.0 * log(255.0 * opacity));
    vec2 pixel = first.xy + place.x * first.zw + place.y * uintBitsToFloat(second.xy);
    gl_Position = vec4(vec2(2, -2) * pixel / size + vec2(-1, 1), 0, 1);
}`;

const SPLAT_FRAGMENT = `#version 300 es
precision highp float;
in vec2 place;
flat in vec4 color;
out vec4 blended;
void main() {
    float alpha = min(0.999, color.a * exp(-0.5 * dot(place, place)));
    if (alpha < 1.0 / 255.0) discard;
    blended = vec4(color.rgb * alpha, alpha);
}`;

// With a minimum alpha at a pixel.
const PICK_FRAGMENT = `#version 300 es
precision highp float;
precision highp int;
in vec2 place;
flat in vec4 color;
flat in uint gaussian;
uniform float least;
out uvec4 picked;
void main() {
    if (min(0.999, color.a * exp(-0.5 * dot(place, place))) < least) discard;
    picked = uvec4(gaussian, 0, 0, 0);
}`;

const SHOW_VERTEX = `#version 300 es
void main() { gl_Position = vec4(vec2(gl_VertexID & 1, gl_VertexID >> 1) * 4.0 - 1.0, 0, 1); }`;

const SHOW_FRAGMENT = `#version 300 es
precision highp float;
uniform sampler2D frame;
uniform vec3 background;
uniform int show;
uniform vec2 range; // the depths at the ends of the palette
out vec4 shown;

vec3 palette(float at) {
    const vec3 colors[${PALETTE.length}] = vec3[](${PALETTE.map(rgb => `vec3(${rgb.map(c => c.toFixed(3))})`)});
    float step = clamp(at, 0.0, 1.0) * ${PALETTE.length - 1}.0;
    int first = min(int(step), ${PALETTE.length - 2});
    return mix(colors[first], colors[first + 1], step - float(first));
}

void main() {
    vec4 seen = texelFetch(frame, ivec2(gl_FragCoord.xy), 0);
    vec3 rgb = seen.rgb + (1.0 - seen.a) * background;
    if (show == 1) rgb = mix(background, palette((seen.r / max(seen.a, 1e-12) - range.x) / (range.y - range.x)), seen.a);
    else if (show == 2) rgb = 0.5 + 0.5 * seen.rgb / max(length(seen.rgb), 1e-12);
    else if (show == 3) rgb = seen.rgb;
    rgb = clamp(rgb, 0.0, 1.0);
    shown = vec4(floor(rgb * 255.0 + 0.05) / 255.0, 1); // the rest offsets half-precision loss
}`;

class Renderer {
    constructor(canvas) {
        const gl = canvas.getContext("webgl2", { antialias: false, alpha: false, powerPreference: "high-performance" });
        if (!gl) throw new Error("This browser offers no WebGL2, which the picture needs: its settings or another browser may.");
        this.gl = gl;
        const float = gl.getExtension("EXT_color_buffer_float") || gl.getExtension("EXT_color_buffer_half_float");
        this.colorFormat = float ? gl.RGBA16F : gl.RGBA8;
        // Depths and normals need the bits.
        this.valueFormat = gl.getExtension("EXT_float_blend") && gl.getExtension("EXT_color_buffer_float") ? gl.RGBA32F : this.colorFormat;
        this.projector = this.program(SHOW_VERTEX, PROJECT_FRAGMENT);
        this.splats = this.program(SPLAT_VERTEX, SPLAT_FRAGMENT);
        this.picks = this.program(SPLAT_VERTEX, PICK_FRAGMENT);
        this.show = this.program(SHOW_VERTEX, SHOW_FRAGMENT);
        this.frame = { texture: gl.createTexture(), buffer: gl.createFramebuffer(), width: 0, height: 0 };
        this.pixel = this.pickBuffer();
        this.empty = gl.createVertexArray();
        this.quads = this.quadArray();
    }

    program(vertex, fragment) {
        const { gl } = this, program = gl.createProgram(), uniforms = {};
        for (const [kind, source] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
            const shader = gl.createShader(kind);
            gl.shaderSource(shader, source);
            gl.compileShader(shader);
            if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS) && !gl.isContextLost())
                throw new Error(`The graphics driver refuses a shader: ${gl.getShaderInfoLog(shader)}`);
            gl.attachShader(program, shader);
        }
        gl.linkProgram(program);
        const count = gl.getProgramParameter(program, gl.ACTIVE_UNIFORMS) ?? 0;
        for (let i = 0; i < count; ++i) {
            const { name } = gl.getActiveUniform(program, i);
            uniforms[name] = gl.getUniformLocation(program, name);
        }
        return { program, uniforms };
    }

    texture(format, width, height) {
        const { gl } = this, texture = gl.createTexture();
        gl.bindTexture(gl.TEXTURE_2D, texture);
        gl.texStorage2D(gl.TEXTURE_2D, 1, format, width, height);
        gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.NEAREST);
        gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MAG_FILTER, gl.NEAREST);
        return texture;
    }

    quadArray() {
        const { gl } = this, array = gl.createVertexArray();
        const corners = Uint16Array.from({ length: 6 * BATCH }, (_, i) => 4 * Math.floor(i / 6) + [0, 1, 2, 2, 1, 3][i % 6]);
        gl.bindVertexArray(array);
        gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, gl.createBuffer());
        gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, corners, gl.STATIC_DRAW);
        gl.bindVertexArray(null);
        return array;
    }

    pickBuffer() {
        const { gl } = this, buffer = gl.createFramebuffer(), texture = this.texture(gl.RGBA32UI, 1, 1);
        gl.bindFramebuffer(gl.FRAMEBUFFER, buffer);
        gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, texture, 0);
        return buffer;
    }

    upload({ count, degree, antialiased, near, gaussians, harmonics }) {
        const { gl } = this, most = gl.getParameter(gl.MAX_TEXTURE_SIZE);
        const texture = (texels, format = gl.RGBA32UI) => {
            const height = Math.max(1, Math.ceil(texels / TEXTURE_WIDTH));
            if (height > most) throw new Error(`${count.toLocaleString("en")} Gaussians of degree ${degree} are more than this device can hold.`);
            return this.texture(format, TEXTURE_WIDTH, height);
        };
        const scene = { count, degree, antialiased, near, drawn: 0, gaussians: texture(3 * count), harmonics: texture(harmonics.length / 4) };
        this.fill(scene.gaussians, gaussians, 4);
        this.fill(scene.harmonics, harmonics, 4);
        scene.order = texture(count, gl.R32UI);
        scene.projection = gl.createFramebuffer();
        gl.bindFramebuffer(gl.FRAMEBUFFER, scene.projection);
        const outputs = PROJECTED.map((name, i) => {
            scene[name] = texture(count);
            gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0 + i, gl.TEXTURE_2D, scene[name], 0);
            return gl.COLOR_ATTACHMENT0 + i;
        });
        gl.drawBuffers(outputs);
        return scene;
    }

    fill(texture, words, channels) {
        const { gl } = this, texels = words.length / channels, whole = Math.floor(texels / TEXTURE_WIDTH);
        const put = (y, width, rows, from) => width && rows &&
            gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, y, width, rows, channels === 1 ? gl.RED_INTEGER : gl.RGBA_INTEGER, gl.UNSIGNED_INT, words, from);
        gl.bindTexture(gl.TEXTURE_2D, texture);
        put(0, TEXTURE_WIDTH, whole, 0);
        put(whole, texels - whole * TEXTURE_WIDTH, 1, channels * whole * TEXTURE_WIDTH);
    }

    release(scene) {
        for (const name of ["gaussians", "harmonics", "order", ...PROJECTED]) this.gl.deleteTexture(scene[name]);
        this.gl.deleteFramebuffer(scene.projection);
    }

    sort(scene, order) {
        this.fill(scene.order, order, 1);
        scene.drawn = order.length;
    }

    resize(width, height, shown = "color") {
        const { gl, frame } = this, format = shown === "color" ? this.colorFormat : this.valueFormat;
        if (frame.width === width && frame.height === height && frame.format === format) return;
        gl.canvas.width = frame.width = width;
        gl.canvas.height = frame.height = height;
        frame.format = format;
        gl.deleteTexture(frame.texture);
        frame.texture = this.texture(format, width, height);
        gl.bindFramebuffer(gl.FRAMEBUFFER, frame.buffer);
        gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, frame.texture, 0);
    }

    // `view`: mode (see SHOWN), Gaussians per token, hovered token, depth range, marked volume.
    draw(scene, camera, background, view = {}) {
        const { gl, frame, show } = this, { width, height } = frame, { shown = "color", range = [0, 1] } = view;
        if (scene?.drawn) this.project(scene, camera, view);
        gl.viewport(0, 0, width, height);
        gl.bindFramebuffer(gl.FRAMEBUFFER, frame.buffer);
        gl.clearColor(0, 0, 0, 0);
        gl.clear(gl.COLOR_BUFFER_BIT);
        if (scene?.drawn) {
            gl.enable(gl.BLEND);
            gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
            this.use(this.splats, scene);
            this.drawQuads(scene);
            gl.disable(gl.BLEND);
        }
        gl.bindVertexArray(this.empty);
        gl.bindFramebuffer(gl.FRAMEBUFFER, null);
        gl.useProgram(show.program);
        gl.activeTexture(gl.TEXTURE0);
        gl.bindTexture(gl.TEXTURE_2D, frame.texture);
        gl.uniform1i(show.uniforms.frame, 0);
        gl.uniform1i(show.uniforms.show, SHOWN[shown]);
        gl.uniform2fv(show.uniforms.range, range);
        gl.uniform3fv(show.uniforms.background, background);
        gl.drawArrays(gl.TRIANGLES, 0, 3);
    }

    project(scene, camera, { shown = "color", group = 1, hovered = -1, volume = null } = {}) {
        const { gl, projector: { program, uniforms } } = this, { width, height } = this.frame;
        const focal = camera.focal(width, height), [right, down, forward] = camera.axes;
        gl.useProgram(program);
        this.bind(uniforms, scene, ["order", "gaussians", "harmonics"]);
        gl.uniformMatrix3fv(uniforms.view, false, [0, 1, 2].flatMap(i => [right[i], down[i], forward[i]]));
        gl.uniform3fv(uniforms.eye, camera.eye);
        gl.uniform2f(uniforms.focal, focal * camera.stretch, focal);
        gl.uniform2fv(uniforms.shift, camera.shift);
        gl.uniform2f(uniforms.size, width, height);
        gl.uniform1f(uniforms.near, scene.near);
        gl.uniform1i(uniforms.degree, scene.degree);
        gl.uniform1i(uniforms.antialiased, scene.antialiased);
        gl.uniform1i(uniforms.show, SHOWN[shown]);
        gl.uniform1ui(uniforms.group, group);
        gl.uniform1i(uniforms.hovered, hovered);
        gl.uniform1i(uniforms.volume, volume?.seeds ? 3 : volume ? 1 + volume.round : 0);
        if (volume?.center) gl.uniform3fv(uniforms.middle, volume.center), gl.uniform3fv(uniforms.reach, volume.half);
        gl.uniform1ui(uniforms.drawn, scene.drawn);
        gl.bindFramebuffer(gl.FRAMEBUFFER, scene.projection);
        gl.viewport(0, 0, TEXTURE_WIDTH, Math.ceil(scene.drawn / TEXTURE_WIDTH));
        gl.bindVertexArray(this.empty);
        gl.drawArrays(gl.TRIANGLES, 0, 3);
    }

    bind(uniforms, scene, names) {
        for (const [unit, name] of names.entries()) {
            this.gl.activeTexture(this.gl.TEXTURE0 + unit);
            this.gl.bindTexture(this.gl.TEXTURE_2D, scene[name]);
            this.gl.uniform1i(uniforms[name], unit);
        }
    }

    use({ program, uniforms }, scene) {
        const { gl } = this;
        gl.useProgram(program);
        this.bind(uniforms, scene, PROJECTED);
        gl.uniform1ui(uniforms.drawn, scene.drawn);
        gl.uniform2f(uniforms.size, this.frame.width, this.frame.height);
        gl.bindVertexArray(this.quads);
        return uniforms;
    }

    drawQuads({ drawn }) {
        this.gl.drawElementsInstanced(this.gl.TRIANGLES, 6 * BATCH, this.gl.UNSIGNED_SHORT, 0, Math.ceil(drawn / BATCH));
    }

    // Nearest with alpha of at least a half, else a tenth.
    pick(scene, camera, x, y) {
        if (!scene?.drawn) return null;
        const { gl } = this, { width, height } = this.frame, found = new Uint32Array(4);
        this.project(scene, camera);
        const uniforms = this.use(this.picks, scene);
        gl.bindFramebuffer(gl.FRAMEBUFFER, this.pixel);
        gl.viewport(-x, y + 1 - height, width, height);
        for (const least of [0.5, 0.1]) {
            gl.clearBufferuiv(gl.COLOR, 0, [0xffffffff, 0, 0, 0]);
            gl.uniform1f(uniforms.least, least);
            this.drawQuads(scene);
            gl.readPixels(0, 0, 1, 1, gl.RGBA_INTEGER, gl.UNSIGNED_INT, found);
            if (found[0] !== 0xffffffff) return found[0];
        }
        return null;
    }

    // Rows from the top: four floats per pixel, alpha last.
    values(x, y, width, height) {
        const { gl, frame } = this, values = new Float32Array(4 * width * height);
        gl.bindFramebuffer(gl.FRAMEBUFFER, frame.buffer);
        gl.readPixels(x, frame.height - y - height, width, height, gl.RGBA, gl.FLOAT, values);
        return Float32Array.from({ length: values.length }, (_, i) => {
            const row = Math.floor(i / 4 / width);
            return values[i + 4 * width * (height - 1 - 2 * row)];
        });
    }

    // Rows from the top, four bytes per pixel.
    bytes() {
        const { gl, frame: { width, height } } = this, rows = new Uint8Array(4 * width * height), bytes = new Uint8Array(rows.length);
        gl.bindFramebuffer(gl.FRAMEBUFFER, null);
        gl.readPixels(0, 0, width, height, gl.RGBA, gl.UNSIGNED_BYTE, rows);
        for (let y = 0; y < height; ++y) bytes.set(rows.subarray(4 * width * y, 4 * width * (y + 1)), 4 * width * (height - 1 - y));
        return bytes;
    }
}
