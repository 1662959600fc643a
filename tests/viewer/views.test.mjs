// Depth, normals and tokens of the page against `zipsplat render`.

import assert from "node:assert/strict";
import { writeFileSync } from "node:fs";
import { before, test } from "node:test";
import { Tab, at, psnr, randomPly, serve, spread, written, zipsplat } from "./browser.mjs";

const MANY = 500_000;

before(() => {
    writeFileSync(at("random.ply"), randomPly(3000));
    zipsplat("scene", "--seed", "3", "--views", "4", "--size", "140x140", "-o", "place", "--splats");
});

// Depths and positions where the page's last picture covers more than half.
const depths = tab => tab.run(() => {
    const { width, height } = zipsplat.renderer.frame, values = zipsplat.renderer.values(0, 0, width, height);
    return Array.from({ length: width * height }, (_, i) => values[4 * i + 3] > 0.5 ? values[4 * i] / values[4 * i + 3] : 0);
});

test("depth, normals and tokens are those of render", async () => {
    for (const scene of ["random.ply", "place/splats.ply"]) {
        const tab = await written([scene, "--lossless", "--gaussians-per-token", "4"]), pictures = {};
        const [depth, normals, tokens] = await tab.rendered(scene, "--depth", "--normals", "--gaussians-per-token", "4");
        for (const [key, shown] of [["2", "depth"], ["3", "normals"], ["4", "tokens"]]) {
            await tab.page.keyboard.press(key);
            pictures[shown] = await tab.picture();
            assert.equal(await tab.run(() => zipsplat.views.shown), shown);
            if (shown === "depth") pictures.values = await depths(tab);
            await tab.screenshot(`view-${shown}-${scene.replace(/\W/g, "-")}`);
        }
        const alike = { normals: psnr(pictures.normals, normals), tokens: psnr(pictures.tokens, tokens) };
        let sum = 0, count = 0;
        pictures.values.forEach((value, i) => value && (sum += Math.abs(value * 1000 / depth.data[4 * i] - 1), ++count));
        console.log(`${scene}: normals ${alike.normals.toFixed(1)} dB, tokens ${alike.tokens.toFixed(1)} dB, depths of ${count} pixels within ${(100 * sum / count).toFixed(3)} %`);
        assert.ok(spread(pictures.depth) > 5 && count > 5000, "depths are shown");
        assert.ok(sum / count < 1e-3, `depths differ by ${sum / count}`);
        assert.ok(alike.normals > 40, `normals: ${alike.normals} dB`);
        assert.ok(alike.tokens > 50, `tokens: ${alike.tokens} dB`);
        await tab.close();
    }
});

test("tiny scenes are not clipped", async () => {
    writeFileSync(at("tiny.ply"), randomPly(3000, [-11, -9], [-3, 5], 1e-4));
    const tab = await written(["tiny.ply", "--lossless"]);
    assert.ok(await tab.run(() => zipsplat.scene.near) < 1e-5);
    assert.ok(await tab.run(() => zipsplat.scene.drawable.drawn) > 2000);
    await tab.close();
});

test("what was left out is counted", async () => {
    const ply = randomPly(3000, [-7, -1.5], [-9, 5]), values = new Float32Array(ply.buffer.slice(ply.byteOffset + ply.length - 4 * 59 * 3000, ply.byteOffset + ply.length));
    // Opacity logit, the 52nd of 59 numbers: 1/255 is -ln 254.
    const faint = Array.from({ length: 3000 }, (_, i) => values[59 * i + 51]).filter(odds => odds < -Math.log(254)).length;
    writeFileSync(at("faint.ply"), ply);
    const tab = await written(["faint.ply", "--lossless"]);
    const said = () => tab.page.$eval("#left-out", element => element.textContent);
    assert.ok(faint > 300);
    assert.equal(await tab.run(() => zipsplat.scene.drawable.drawn), 3000 - faint, "all that are not faint lie ahead");
    assert.match(await said(), /of 3,000 Gaussians drawn/);
    await tab.run(() => (zipsplat.camera.move(0, 0, 1), zipsplat.change(true)));
    await tab.page.waitForFunction(faint => zipsplat.scene.drawable.drawn < 2900 - faint, {}, faint);
    await tab.settled();
    const [, drawn, weak, behind] = /([\d,]+) of 3,000 .*: ([\d,]+) are fainter.*?, ([\d,]+) lie behind/.exec(await said()).map(word => Number(word.replace(",", "")));
    assert.equal(drawn + weak + behind, 3000);
    assert.equal(weak, faint);
    assert.ok(behind > 100);
    await tab.close();
});

test("tokens of a file that does not say are refused with words", async () => {
    const tab = await written(["random.ply"]);
    await tab.page.keyboard.press("4");
    assert.equal(await tab.run(() => zipsplat.views.shown), "color");
    assert.match(await tab.page.$eval("#message", element => element.textContent), /--gaussians-per-token N/);
    await tab.close();
});

test("half a million Gaussians are drawn, the most visible ones before all have arrived", async () => {
    writeFileSync(at("many.ply"), randomPly(MANY, [-7, -5.5]));
    const { address, stop } = await serve("view", "many.ply"), begin = performance.now();
    const tab = await Tab.open(address), since = () => Math.round(performance.now() - begin);
    await tab.until(() => zipsplat.scene.drawable?.drawn && !zipsplat.waiting);
    const { count, all, facts } = await tab.run(() => ({ ...zipsplat.scene, facts: document.getElementById("facts").textContent }));
    console.log(`the first picture, of ${count} Gaussians, after ${since()} ms: ${facts}`);
    assert.ok(all === MANY && count < all / 4, `${count} of ${all}`);
    assert.ok(facts.startsWith(`${count.toLocaleString("en")} of 500,000 Gaussians`), facts);
    await tab.screenshot("first");
    await tab.press("edit-button");
    assert.ok(await tab.page.$eval("#save-scene", element => element.disabled), "a part is not saved");
    await tab.press("edit-button");
    await tab.settled();
    console.log(`all Gaussians after ${since()} ms`);
    assert.deepEqual(await tab.run(() => [zipsplat.scene.count, zipsplat.scene.partial]), [MANY, false]);
    const found = psnr(await tab.picture(), await tab.rendered("many.ply"));
    console.log(`many.ply: ${found.toFixed(1)} dB`);
    assert.ok(found > 50, `${found} dB`);
    await tab.close();
    await stop();
});
