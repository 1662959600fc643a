// Live reconstruction in the page: ratio slider, tokens, refinement.

import assert from "node:assert/strict";
import { readFileSync } from "node:fs";
import { before, test } from "node:test";
import { PNG } from "pngjs";
import { Tab, at, opened, psnr, serve, sleep, spread, zipsplat } from "./browser.mjs";

const PHOTOS = ["place/images", "--cameras", "place/transforms.json"];

before(() => zipsplat("scene", "--seed", "3", "--views", "4", "--size", "140x140", "-o", "place"));

const label = tab => tab.page.$eval("#ratio-label", element => element.textContent);
const made = (tab, ratio) => tab.page.waitForFunction(ratio => zipsplat.scene.source?.startsWith(`made/${ratio}/`) && zipsplat.live.took, { timeout: 300_000 }, ratio);
// Slider position of a ratio.
const place = ratio => 100 * (1 - Math.log(ratio) / Math.log(0.01));

test("the slider makes scenes of other ratios, and drops what is overtaken", async () => {
    const { address, stop } = await serve("view", ...PHOTOS), tab = await Tab.open(address, { width: 500, height: 500 });
    await made(tab, 1);
    await tab.settled();
    const [all, group] = await tab.run(() => [zipsplat.scene.count, zipsplat.scene.group]), whole = await tab.picture();
    assert.ok(spread(whole) > 5);
    // At ratio 1, tokens are the patches in order: 9 by 9 per photo.
    const patches = await tab.run(() => [0, 80, 81, 92].map(token => Object.values(zipsplat.tokens.patch(token))));
    assert.deepEqual(patches, [[0, 0, 0], [0, 8, 8], [1, 0, 0], [1, 1, 2]]);
    assert.match(await label(tab), /Ratio 1: ([\d,]+) of \1 tokens.*backbone|fuse/);
    await tab.screenshot("ratio-1");
    await tab.slide("ratio", place(0.1));
    await made(tab, 0.1);
    await tab.settled();
    const tenth = await tab.run(() => zipsplat.scene.count);
    assert.equal(tenth, Math.floor(0.1 * all / group) * group);
    const alike = psnr(whole, await tab.picture());
    assert.ok(alike < 40, `the picture changes: ${alike} dB`);
    for (const word of ["cluster", "fuse", "gaussians", "send", "load"]) assert.ok((await label(tab)).includes(word), word);
    await tab.screenshot("ratio-0.1");
    await tab.slide("ratio", 100);
    await made(tab, 1);
    assert.equal(psnr(whole, await tab.picture()) > 90, true);
    // While the slider moves, only the last ratio is shown.
    const swaps = tab.run(() => {
        globalThis.swapped = [];
        const { swap } = zipsplat;
        zipsplat.swap = function (index, facts, bytes) {
            swapped.push(facts.source);
            return swap.call(this, index, facts, bytes);
        };
    });
    await swaps;
    for (let i = 0; i < 20; ++i) await tab.slide("ratio", 30 + i);
    await tab.slide("ratio", place(0.2));
    await made(tab, 0.2);
    await sleep(500);
    const swapped = await tab.run(() => globalThis.swapped);
    assert.ok(swapped.length < 12 && swapped.at(-1).startsWith("made/0.2/"), swapped.join(" "));
    await tab.close();
    assert.equal(await stop(), 0);
});

test("a token under the mouse shows its patch of the photo", async () => {
    const { address, stop } = await serve("view", ...PHOTOS, "--ratio", "0.3"), tab = await Tab.open(address, { width: 700, height: 500 });
    await tab.until(() => zipsplat.live.took);
    await tab.settled();
    await tab.page.keyboard.press("4");
    await tab.settled();
    const plain = await tab.picture();
    await tab.page.mouse.move(350, 230);
    await tab.until(() => zipsplat.tokens.hovered >= 0);
    await tab.until(() => document.getElementById("source-photo").width === document.getElementById("source-photo").height);
    await tab.screenshot("token");
    const { token, patch, words } = await tab.run(() => {
        const token = zipsplat.tokens.hovered;
        return { token, patch: zipsplat.tokens.patch(token), words: document.getElementById("source-words").textContent };
    });
    assert.match(words, new RegExp(`Token ${token + 1} of .*: 00\\d\\.png, patch ${patch.column + 1} across, ${patch.row + 1} down`));
    assert.ok(psnr(plain, await tab.picture()) < 60, "the token stands out");
    // The highlighted patch of the photo is drawn over a darkened copy.
    const light = await tab.run(({ row, column }) => {
        const canvas = document.getElementById("source-photo"), side = canvas.width / config.grid[1], context = canvas.getContext("2d");
        const mean = (x, y) => context.getImageData(x, y, side - 2, side - 2).data.reduce((sum, value) => sum + value, 0);
        return mean(column * side + 1, row * side + 1) / mean(column * side + 1, (row > 2 ? row - 2 : row + 2) * side + 1);
    }, patch);
    assert.ok(light > 1.1, `the patch is lit: ${light}`);
    await tab.page.keyboard.press("1");
    assert.ok(await tab.page.$eval("#source", element => element.hidden));
    await tab.close();
    await stop();
});

test("a written page holds several ratios, tokens and small photos, and asks nobody", async () => {
    const said = JSON.parse(zipsplat("view", ...PHOTOS, "--ratios", "1,0.3,0.1", "-o", "page.html", "--json")).result;
    assert.equal(said.gaussians.length, 3);
    assert.ok(said.photos === 4 && said.photo_bytes > 1000 && said.bytes > said.photo_bytes);
    const tab = await opened({ width: 700, height: 500 }), seen = [];
    for (const i of [0, 1, 2]) {
        await tab.slide("scene", i);
        await tab.settled();
        seen.push([await tab.run(() => zipsplat.scene.count), await tab.picture()]);
    }
    assert.deepEqual(seen.map(([count]) => count), said.gaussians);
    assert.ok(psnr(seen[0][1], seen[2][1]) < 40);
    assert.match(await tab.page.$eval("#scene-label", element => element.textContent), /3 of 3: ratio 0.1.*holds 3 ratios/);
    await tab.page.keyboard.press("4");
    await tab.page.mouse.move(350, 230);
    await tab.until(() => zipsplat.tokens.hovered >= 0 && document.getElementById("source-photo").width > 0);
    await tab.page.keyboard.press(".");
    await tab.until(() => document.getElementById("photo").naturalWidth === 140);
    assert.equal(tab.requests.length, 1);
    await tab.close();
});

test("a photo over the picture says how like it the picture is", async () => {
    const { address, stop } = await serve("view", ...PHOTOS, "--ratio", "0.3"), tab = await Tab.open(address, { width: 140, height: 140 });
    await tab.until(() => zipsplat.live.took);
    const said = [];
    for (const input of [1, 2]) {
        await tab.page.keyboard.press(".");
        await tab.page.waitForFunction(input => zipsplat.input === input && / dB, 140 x 140/.test(document.getElementById("photo-label").textContent), {}, input);
        said.push(parseFloat(await tab.page.$eval("#photo-label", element => element.textContent)));
        const photo = PNG.sync.read(readFileSync(at(`place/images/00${input}.png`)));
        const alike = psnr(await tab.picture(), photo);
        assert.ok(alike > 5 && Math.abs(said.at(-1) - alike) < 0.02, `${said.at(-1)} dB beside ${alike}`);
    }
    assert.notEqual(said[0], said[1]);
    // Another scene changes the figure.
    await tab.slide("ratio", place(0.05));
    await made(tab, 0.05);
    await tab.page.waitForFunction(before => document.getElementById("photo-label").textContent !== before, {}, `${said[1].toFixed(2)} dB, 140 x 140`);
    await tab.page.setViewport({ width: 700, height: 500 });
    await tab.screenshot("photo");
    await tab.close();
    await stop();
});

test("a refinement is watched, and stopped with the best so far", async () => {
    const { address, stop } = await serve("view", ...PHOTOS, "--refine=2000", "--max-image-size", "70x70"), tab = await Tab.open(address, { width: 700, height: 500 });
    await tab.until(() => zipsplat.refining.version >= 1 && zipsplat.live.took);
    await tab.settled();
    const first = await tab.picture(), version = await tab.run(() => zipsplat.refining.version);
    await tab.page.waitForFunction(version => zipsplat.refining.version > version, { timeout: 300_000 }, version);
    await tab.settled();
    assert.ok(psnr(first, await tab.picture()) < 60, "the picture changes");
    await tab.screenshot("refining");
    const { step, losses } = await tab.run(() => zipsplat.refining.state);
    assert.ok(step >= 2 && losses.at(-1) < losses[0], `${losses[0]} to ${losses.at(-1)}`);
    assert.match(await tab.page.$eval("#refined-label", element => element.textContent), /Step \d+ of 2000 · loss/);
    await tab.page.click("#stop");
    await tab.until(() => zipsplat.refining.state.ended);
    assert.match(await tab.run(() => zipsplat.refining.state.ended), /^Stopped: kept is step \d+, the best so far/);
    await tab.close();
    assert.equal(await stop(), 0);
});
