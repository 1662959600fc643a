import assert from "node:assert/strict";
import { readFileSync, writeFileSync } from "node:fs";
import { before, test } from "node:test";
import { pathToFileURL } from "node:url";
import { PNG } from "pngjs";
import { Tab, at, psnr, randomPly, serve, sleep, spread, written, zipsplat } from "./browser.mjs";

const AGREES = 56; // dB against `render`: rounding only
const COUNT = 3000;

before(() => {
    writeFileSync(at("random.ply"), randomPly(COUNT));
    zipsplat("scene", "--seed", "3", "--views", "4", "--size", "140x140", "-o", "place", "--splats");
    for (const [name, ...options] of [["two.spz", "--spz-version", "2"], ["three.spz"], ["four.spz", "--spz-version", "4"], ["one.sog"], ["one.splat"], ["one.glb"], ["one.gltf"],
        ["thin.ply", "--antialiased"], ["thin.spz", "--antialiased"], ["thin.sog", "--antialiased"]])
        zipsplat("convert", "random.ply", name, ...options);
});

async function agrees(tab, file) {
    const picture = await tab.picture();
    assert.ok(spread(picture) > 5, "the picture shows something");
    const found = psnr(picture, await tab.rendered(file));
    console.log(`${file}: ${found.toFixed(1)} dB`);
    assert.ok(found > AGREES, `${file}: ${found} dB`);
}

test("a page in one file draws what render draws, and asks nobody for anything", async () => {
    for (const scene of ["random.ply", "place/splats.ply"]) {
        const tab = await written([scene, "--lossless"]);
        await agrees(tab, scene);
        await tab.run(() => (zipsplat.camera.orbit(0.3, -0.2), zipsplat.camera.move(0.1, 0.1, 0.2), zipsplat.change(true)));
        await sleep(600);
        await agrees(tab, scene);
        assert.deepEqual(tab.requests, [pathToFileURL(at("page.html")).href]);
        await tab.close();
    }
});

test("input cameras keep their principal points and focal lengths", async () => {
    const frame = { file_path: "a.png", transform_matrix: [[1, 0, 0, 0], [0, -1, 0, 0], [0, 0, -1, 0], [0, 0, 0, 1]] };
    writeFileSync(at("lens.json"), JSON.stringify({ fl_x: 90, fl_y: 110, cx: 40, cy: 75, w: 120, h: 120, frames: [frame] }));
    const tab = await written(["random.ply", "--lossless", "--cameras", "lens.json"], { width: 120, height: 120 });
    await tab.run(() => zipsplat.through(0));
    zipsplat("render", "random.ply", "--cameras", "lens.json", "-o", "lens");
    const found = psnr(await tab.picture(), PNG.sync.read(readFileSync(at("lens/000.png"))));
    assert.ok(found > AGREES, `${found} dB`);
    await tab.close();
});

test("a packed page draws what render draws of the SPZ", async () => {
    const tab = await written(["random.ply"]);
    await agrees(tab, "three.spz");
    await tab.close();
});

test("files of each format can be dropped", async () => {
    const tab = await written(["random.ply"]);
    for (const file of ["random.ply", "two.spz", "three.spz", "four.spz", "one.sog", "one.splat", "one.glb", "one.gltf"]) {
        await tab.drop(file, readFileSync(at(file)));
        await tab.settled();
        assert.deepEqual(await tab.run(() => [zipsplat.scene.name, zipsplat.scene.count]), [file, COUNT]);
        await agrees(tab, file);
    }
    await tab.close();
});

test("antialiased scenes are drawn as such", async () => {
    const tab = await written(["random.ply"]);
    for (const file of ["thin.ply", "thin.spz", "thin.sog"]) {
        await tab.drop(file, readFileSync(at(file)));
        await tab.settled();
        await agrees(tab, file);
        assert.ok(psnr(await tab.picture(), await tab.rendered(file, "--antialiased=false")) < 45, `${file} is faded`);
    }
    await tab.close();
});

test("a broken file gives clear words and leaves the others", async () => {
    const tab = await written(["random.ply"]), ply = readFileSync(at("random.ply")), spz = readFileSync(at("three.spz"));
    for (const [name, bytes, words] of [
        ["cut.glb", readFileSync(at("one.glb")).subarray(0, 90_000), /cut off/],
        ["plain.gltf", Buffer.from('{"asset":{"version":"2.0"}}'), /no Gaussians/],
        ["cut.ply", ply.subarray(0, 100_000), /cut off: 3000 Gaussians/],
        ["head.ply", ply.subarray(0, 100), /header has no end/],
        ["points.ply", readFileSync(at("place/points.ply")), /no f_dc_0.*no 3D Gaussians/],
        ["cut.spz", spz.subarray(0, 1000), /damaged or cut off/],
        ["cut4.spz", readFileSync(at("four.spz")).subarray(0, 20_000), /damaged or cut off/],
        ["cut.sog", readFileSync(at("one.sog")).subarray(0, 20_000), /no ZIP archive/],
        ["cut.splat", Buffer.alloc(33), /33 bytes are no multiple of 32/],
        ["words.txt", Buffer.from("no scene"), /no scene: this page reads PLY, SPZ, SOG, .splat and glTF/],
        ["empty.ply", Buffer.alloc(0), /empty/],
    ]) {
        await tab.drop(name, bytes);
        const said = await tab.failure();
        assert.match(said, words);
        assert.ok(said.startsWith(`${name}: `), said);
        await tab.run(() => zipsplat.choose(0));
        await tab.settled();
        assert.ok(await tab.page.$eval("#message", element => element.hidden));
    }
    await tab.close();
});

test("mouse, keys and touch move the camera, and reset brings it back", async () => {
    const tab = await written(["place/splats.ply"], { width: 1280, height: 800 }), { mouse, keyboard } = tab.page;
    const view = () => tab.run(() => [...zipsplat.camera.eye, ...zipsplat.camera.axes.flat()]);
    const home = await view();
    const moves = async (what, act) => {
        await tab.page.keyboard.press("r");
        assert.deepEqual(await view(), home, `reset before ${what}`);
        await act();
        assert.notDeepEqual(await view(), home, what);
    };
    const drag = button => async () => {
        await mouse.move(500, 400);
        await mouse.down({ button });
        await mouse.move(600, 430);
        await mouse.up({ button });
    };
    await tab.screenshot("desktop");
    await moves("a drag", drag("left"));
    const [x] = await view();
    assert.ok(x < home[0], "a drag to the right takes the camera to the left");
    await moves("a right drag", drag("right"));
    await moves("the wheel", () => mouse.wheel({ deltaY: -300 }));
    for (const key of ["w", "ArrowLeft"]) await moves(key, () => keyboard.press(key));
    await keyboard.press("h");
    assert.ok(await tab.page.$eval("#help", element => !element.hidden));
    await tab.screenshot("help");
    await keyboard.press("Escape");
    await tab.page.setViewport({ width: 390, height: 844, hasTouch: true, isMobile: true, deviceScaleFactor: 2 });
    await sleep(500);
    await tab.settled();
    await tab.screenshot("phone");
    const first = await tab.page.touchscreen.touchStart(150, 400), second = await tab.page.touchscreen.touchStart(250, 400);
    const before = await tab.run(() => zipsplat.camera.distance);
    await second.move(330, 400);
    await first.end();
    await second.end();
    assert.ok(await tab.run(() => zipsplat.camera.distance) < before, "a pinch outwards comes nearer");
    await tab.close();
});

test("several scenes stand behind one slider", async () => {
    const tab = await written(["one.splat", "two.spz", "random.ply"], { width: 800, height: 600 });
    for (const [i, name] of ["one.splat", "two.spz", "random.ply"].entries()) {
        await tab.slide("scene", i);
        await tab.settled();
        const label = await tab.page.$eval("#scene-label", element => element.textContent);
        assert.ok(label.startsWith(`${i + 1} of 3: ${name}, 3,000 Gaussians`), label);
    }
    await tab.screenshot("slider");
    await tab.close();
});

test("a served page shows input cameras with their photos", async () => {
    const { address, stop } = await serve("view", "place/splats.ply", "--cameras", "place/transforms.json");
    const tab = await Tab.open(address, { width: 800, height: 600 });
    await tab.settled();
    await agrees(tab, "place/splats.ply");
    await tab.page.keyboard.press(".");
    await tab.page.waitForFunction(() => document.getElementById("photo").naturalWidth === 140);
    assert.equal(await tab.run(() => zipsplat.input), 1);
    await tab.settled();
    await tab.screenshot("photo");
    await tab.page.keyboard.press("c");
    await tab.run(() => (zipsplat.camera.zoom(2.5), zipsplat.change(true)));
    await sleep(800);
    await tab.settled();
    await tab.screenshot("cameras");
    assert.ok(tab.requests.every(url => url.startsWith(address)), tab.requests.join(" "));
    await tab.close();
    assert.equal(await stop(), 0);
});
