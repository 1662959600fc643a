import assert from "node:assert/strict";
import { mkdirSync, readFileSync, writeFileSync } from "node:fs";
import { before, test } from "node:test";
import { gunzipSync } from "node:zlib";
import { PNG } from "pngjs";
import { Tab, at, psnr, randomPly, serve, sleep, written, zipsplat } from "./browser.mjs";

const COUNT = 3000;
const DESKTOP = { width: 1280, height: 800 };
const PHONE = { width: 390, height: 844, hasTouch: true, isMobile: true, deviceScaleFactor: 2 };
// Gaussians of three objects side by side, and their labels.
const OBJECTS = [[60, 1], [30, 1], [40, 2]];
const SIZES = [["desktop", DESKTOP], ["phone", PHONE]];

before(() => {
    writeFileSync(at("random.ply"), randomPly(COUNT));
    zipsplat("scene", "--seed", "3", "--views", "4", "--size", "140x140", "-o", "place", "--splats");
    zipsplat("convert", "random.ply", "one.spz");
    placeObjects();
    zipsplat("convert", "random.ply", "one.sog", "--antialiased");
});

// Writes objects.ply at x -1, 0 and 1 behind a camera, and labels of its picture as features.
function placeObjects() {
    const bytes = randomPly(130, [-3, -3], [-2, 0], 0.2), start = bytes.length - 4 * 59 * 130;
    for (let i = 0, row = start; row < bytes.length; ++i, row += 4 * 59) {
        bytes.writeFloatLE(bytes.readFloatLE(row) + (i < 60 ? -1 : i < 90 ? 0 : 1), row);
        bytes.writeFloatLE(bytes.readFloatLE(row + 8) + 3, row + 8);
    }
    writeFileSync(at("objects.ply"), bytes);
    const labels = new PNG({ width: 64, height: 64, colorType: 0 });
    for (let i = 0; i < 4096; ++i) labels.data.fill(i % 64 > 41 ? 2 : 1, 4 * i, 4 * i + 3), labels.data[4 * i + 3] = 255;
    mkdirSync(at("labels"));
    writeFileSync(at("labels/a.png"), PNG.sync.write(labels, { colorType: 0 }));
    const frame = { file_path: "a.png", transform_matrix: [[1, 0, 0, 0], [0, -1, 0, 0], [0, 0, -1, 0], [0, 0, 0, 1]] };
    writeFileSync(at("cameras.json"), JSON.stringify({ fl_x: 64, fl_y: 64, cx: 32, cy: 32, w: 64, h: 64, frames: [frame] }));
    zipsplat("lift", "objects.ply", "labels", "--labels", "3", "--cameras", "cameras.json", "-o", "labels.safetensors");
}

const state = tab => tab.run(() => {
    const { edit: { volume }, scene } = zipsplat;
    return { center: [...volume.center], half: [...volume.half], inside: document.getElementById("inside").textContent, count: scene.count, edits: scene.edits };
});

// Waits until the latest count is there.
async function counted(tab) {
    await tab.until(() => !zipsplat.edit.waits && !zipsplat.edit.again);
    return state(tab);
}

// Gaussians of a file between two corners, or in a sphere, as `zipsplat edit` counts.
function cropped(file, { center, half }, round) {
    const numbers = round ? [...center, half[0]] : [...center.map((c, i) => c - half[i]), ...center.map((c, i) => c + half[i])];
    return JSON.parse(zipsplat("edit", file, `--crop-${round ? "sphere" : "box"}`, numbers.join(), "-o", "cropped.ply", "--json")).result.gaussians;
}

// Drags handle `index` by pixels, with the mouse or a finger.
async function drag(tab, index, dx, dy) {
    const [x, y] = await tab.run(index => zipsplat.edit.handles()[index].seen, index), { mouse, touchscreen } = tab.page;
    if (tab.page.viewport().hasTouch) {
        const finger = await touchscreen.touchStart(x, y);
        await finger.move(x + dx, y + dy);
        await finger.end();
    } else {
        await mouse.move(x, y);
        await mouse.down();
        await mouse.move(x + dx, y + dy, { steps: 4 });
        await mouse.up();
    }
    return counted(tab);
}

for (const [name, viewport] of SIZES)
    test(`handles crop by a box and a sphere, ${name}`, async () => {
        const tab = await written(["place/splats.ply", "--lossless"], viewport), eye = () => tab.run(() => zipsplat.camera.eye);
        await tab.press("edit-button");
        await tab.settled();
        const first = await counted(tab), from = await eye();
        await tab.screenshot(`box-${name}`);
        const whole = first.count;
        assert.match(first.inside, new RegExp(`^[\\d,]+ of ${whole.toLocaleString("en")} Gaussians inside$`));
        const inside = ({ inside }) => Number(inside.split(" ")[0].replaceAll(",", ""));
        assert.equal(inside(first), cropped("place/splats.ply", first));
        const narrow = await drag(tab, 2, -30, 0);
        assert.ok(narrow.half[0] < first.half[0] && narrow.half[1] === first.half[1], "a face moves along its axis");
        assert.ok(Math.abs(narrow.center[0] - narrow.half[0] - (first.center[0] - first.half[0])) < 1e-6, "and leaves the others");
        assert.equal(inside(narrow), cropped("place/splats.ply", narrow));
        const moved = await drag(tab, 0, 20, 10);
        assert.ok(moved.center[0] > narrow.center[0] && moved.half.every((half, i) => half === narrow.half[i]), "the center moves the box");
        await tab.slide("volume", "sphere");
        const sphere = await counted(tab), small = await drag(tab, 4, 0, -40);
        assert.ok(small.half[0] < sphere.half[0] && small.half.every(half => half === small.half[0]), "a sphere keeps its shape");
        assert.equal(inside(small), cropped("place/splats.ply", small, true));
        assert.deepEqual(await eye(), from, "the camera stays");
        await tab.screenshot(`sphere-${name}`);
        await tab.press("keep");
        assert.equal((await counted(tab)).count, inside(small));
        await tab.press("fit");
        assert.ok(inside(await counted(tab)) > 0.6 * inside(small), "the rest is fitted");
        await tab.press("edit-button");
        await tab.screenshot(`kept-${name}`);
        await tab.page.setViewport({ ...viewport, deviceScaleFactor: 1 });
        assert.ok(psnr(await tab.picture(), await tab.rendered("cropped.ply")) > 56, "the picture is that of the cropped scene");
        await tab.close();
    });

for (const [name, viewport] of SIZES)
    test(`deletions are undone one by one, ${name}`, async () => {
        const tab = await written(["random.ply", "--lossless"], viewport), whole = await tab.picture();
        await tab.press("edit-button");
        const counts = [(await counted(tab)).count];
        for (const shape of ["box", "sphere"]) {
            await tab.slide("volume", shape);
            // The box in the middle, the sphere at its edge.
            await tab.run(() => {
                const { volume } = zipsplat.edit;
                volume.half = volume.half.map(half => 0.6 * half);
                if (volume.round) volume.center[0] += 2 * volume.half[0];
                zipsplat.edit.moved();
            });
            await counted(tab);
            await tab.page.keyboard.press("Delete");
            counts.push((await counted(tab)).count);
        }
        assert.ok(counts[0] === COUNT && counts[1] < counts[0] && counts[2] < counts[1], counts.join());
        await tab.screenshot(`deleted-${name}`);
        await tab.press("undo");
        assert.equal((await counted(tab)).count, counts[1]);
        await tab.page.keyboard.down("Control");
        await tab.page.keyboard.press("z");
        await tab.page.keyboard.press("z");
        await tab.page.keyboard.up("Control");
        const { count, edits } = await counted(tab);
        assert.deepEqual([count, edits], [COUNT, 0]);
        await tab.press("edit-button");
        await tab.run(() => zipsplat.reset());
        assert.ok((await tab.picture()).data.equals(whole.data), "undone");
        assert.ok(await tab.page.$eval("#undo", element => element.disabled));
        await tab.close();
    });

for (const [name, viewport] of SIZES)
    test(`clicks select objects by their features, ${name}`, async () => {
        const options = ["objects.ply", "--features", "labels.safetensors"], server = viewport.hasTouch && await serve("view", ...options);
        const tab = server ? await Tab.open(server.address, viewport) : await written(options, viewport), { mouse, touchscreen } = tab.page;
        await tab.settled();
        await tab.press("edit-button");
        await tab.slide("volume", "object");
        const inside = async () => Number((await counted(tab)).inside.split(" ")[0]), place = x => tab.run(x => zipsplat.overlay.project([x, 0, 3.5]), x);
        await tab.run(() => zipsplat.canvas.addEventListener("click", () => globalThis.clicked = true));
        const click = async x => {
            await tab.settled();
            await tab.run(() => globalThis.clicked = false);
            const at = await place(x);
            // A busy page takes a tap for a long press.
            for (; !await tab.run(() => clicked); await sleep(500)) await (viewport.hasTouch ? touchscreen.tap(...at) : mouse.click(...at));
            return inside();
        };
        assert.equal(await inside(), 0);
        const plain = await tab.picture();
        assert.equal(await click(-1), OBJECTS[0][0], "not the other with its label");
        const tinted = await tab.picture(), columns = new Set();
        for (let i = 0; i < plain.data.length; ++i) if (plain.data[i] !== tinted.data[i]) columns.add(Math.floor(i / 4) % plain.width);
        assert.ok(columns.size > 0 && Math.max(...columns) < (await place(-0.5))[0] * plain.width / viewport.width, "only it is tinted");
        await tab.screenshot(`object-${name}`);

        const eye = () => tab.run(() => zipsplat.camera.eye), from = await eye(), [x, y] = await place(1);
        const finger = viewport.hasTouch && await touchscreen.touchStart(x, y);
        if (!finger) await mouse.move(x, y), await mouse.down();
        await (finger ?? mouse).move(x + 30, y);
        await (finger ? finger.end() : mouse.up());
        assert.notDeepEqual(await eye(), from, "a drag turns");
        assert.equal(await inside(), OBJECTS[0][0], "and selects nothing");

        if (viewport.hasTouch) await tab.press("add");
        else await tab.page.keyboard.down("Shift");
        assert.equal(await click(0), OBJECTS[0][0] + OBJECTS[1][0], "another of its kind is added");
        await click(1);
        assert.ok(await inside() < 130, "features unlike their mean are not inside");
        await tab.slide("least", 0.3);
        assert.equal(await inside(), 130);
        if (viewport.hasTouch) await tab.press("add");
        else await tab.page.keyboard.up("Shift");
        assert.equal(await click(-0.5), 0, "the background clears");
        assert.equal(await click(1), OBJECTS[2][0]);

        await tab.press("delete");
        assert.equal((await counted(tab)).count, 90);
        await tab.screenshot(`object-deleted-${name}`);
        writeFileSync(at("saved.ply"), (await tab.saved("save-scene"))[1]);
        assert.equal(JSON.parse(zipsplat("convert", "saved.ply", "--json")).result.gaussians, 90);
        await tab.press("undo");
        assert.deepEqual([(await counted(tab)).count, await inside()], [130, OBJECTS[2][0]]);
        await tab.press("keep");
        assert.equal((await counted(tab)).count, OBJECTS[2][0]);
        await tab.drop("random.ply", readFileSync(at("random.ply")));
        await tab.settled();
        assert.deepEqual(await tab.run(() => [...["object", "likeness", "fit"].map(id => document.getElementById(id).hidden), zipsplat.edit.picks]), [true, true, false, false]);
        await tab.close();
        await server?.stop?.();
    });

test("edited scenes are saved as PLY and SPZ", async () => {
    const tab = await written(["random.ply"], DESKTOP);
    for (const file of ["random.ply", "one.sog", "one.spz"]) {
        if (file === "one.spz") {
            await tab.page.setViewport({ ...PHONE, deviceScaleFactor: 1 });
            await sleep(500);
            await tab.settled();
        }
        await tab.drop(file, readFileSync(at(file)));
        await tab.settled();
        await tab.press("edit-button");
        await tab.slide("volume", "sphere");
        await tab.press("fit");
        const { center, half } = await counted(tab);
        await tab.press("delete");
        const { count } = await counted(tab);
        const kept = COUNT - cropped(file, { center, half }, true);
        assert.equal(count, kept);
        await tab.press("edit-button");
        const picture = await tab.picture();
        for (const [kind, least] of [["ply", 56], ["spz", file === "one.spz" ? 50 : 30]]) {
            await tab.slide("kind", kind);
            const [name, bytes] = await tab.saved("save-scene");
            assert.equal(name, `${file.split(".")[0]}.${kind}`);
            writeFileSync(at(`saved.${kind}`), bytes);
            const facts = JSON.parse(zipsplat("convert", `saved.${kind}`, "--json")).result;
            assert.deepEqual([facts.gaussians, facts.antialiased], [kept, file === "one.sog"]);
            const alike = psnr(picture, await tab.rendered(`saved.${kind}`));
            console.log(`${file} without ${COUNT - kept} as ${kind}: ${alike.toFixed(1)} dB, ${bytes.length} bytes`);
            assert.ok(alike > least, `${file} as ${kind}: ${alike} dB`);
        }
        if (file === "random.ply") {
            // Rows of a PLY are copied.
            const [ours, engines] = ["saved.spz", "engine.spz"].map(name => {
                if (name === "engine.spz") zipsplat("convert", "saved.ply", name);
                return gunzipSync(readFileSync(at(name)));
            });
            const other = ours.reduce((sum, byte, i) => sum + (byte !== engines[i]), 0);
            console.log(`${other} of ${ours.length} bytes differ from zipsplat convert`);
            assert.ok(ours.length === engines.length && other < 1e-3 * ours.length, `${other} bytes differ`);
            const own = readFileSync(at(file)), cut = readFileSync(at("saved.ply")), row = 4 * 59, tail = cut.subarray(cut.indexOf("end_header\n") + 11);
            assert.equal(tail.length, row * kept);
            assert.ok(own.includes(tail.subarray(0, row)) && own.includes(tail.subarray(-row)));
        }
    }
    await tab.close();
});

test("an unchanged scene is saved as it came", async () => {
    const tab = await written(["random.ply"], DESKTOP);
    await tab.drop("one.spz", readFileSync(at("one.spz")));
    await tab.settled();
    assert.equal(await tab.page.$eval("#kind", element => element.value), "spz");
    const [name, bytes] = await tab.saved("save-scene");
    assert.ok(name === "one.spz" && bytes.equals(readFileSync(at("one.spz"))));
    await tab.close();
});
