// Key cameras: played, saved and recorded.

import assert from "node:assert/strict";
import { execFileSync } from "node:child_process";
import { readFileSync, writeFileSync } from "node:fs";
import { before, test } from "node:test";
import { PNG } from "pngjs";
import { Tab, at, psnr, serve, written, zipsplat } from "./browser.mjs";

before(() => zipsplat("scene", "--seed", "3", "--views", "4", "--size", "140x140", "-o", "place", "--splats"));

// Keeps two key cameras and returns the page's picture of the first.
async function kept(tab) {
    await tab.settled();
    const picture = await tab.picture();
    await tab.page.keyboard.press("k");
    await tab.run(() => (zipsplat.camera.orbit(0.3, 0.1), zipsplat.camera.zoom(0.8)));
    await tab.page.keyboard.press("k");
    await tab.slide("seconds", 0.5);
    return picture;
}

const hasFfmpeg = () => {
    try {
        execFileSync("ffmpeg", ["-version"], { stdio: "ignore" });
        return true;
    } catch {
        return false;
    }
};

test("a path plays from its first key camera to its last", async () => {
    const tab = await written(["place/splats.ply"]);
    await kept(tab);
    const keys = await tab.run(() => zipsplat.path.keys);
    await tab.slide("seconds", 3);
    await tab.run(() => {
        zipsplat.reset();
        globalThis.shares = [];
        const { at } = zipsplat.path;
        zipsplat.path.at = share => (shares.push(share), at.call(zipsplat.path, share));
    });
    await tab.page.keyboard.press(" ");
    await tab.until(() => zipsplat.path.playing === null);
    const shares = await tab.run(() => globalThis.shares);
    assert.ok(shares.length > 2 && shares.at(-1) === 1 && shares.every((share, i) => i === 0 || share > shares[i - 1]), shares.join(" "));
    const eye = await tab.run(() => zipsplat.camera.eye);
    eye.forEach((value, i) => assert.ok(Math.abs(value - keys[1].eye[i]) < 1e-9));
    const [from, halfway, to] = await tab.run(() => [0, 0.5, 1].map(share => zipsplat.path.at(share).axes[2]));
    const angle = (a, b) => Math.acos(Math.min(1, a.reduce((sum, value, i) => sum + value * b[i], 0)));
    assert.ok(Math.abs(angle(from, halfway) - angle(halfway, to)) < 0.02 && angle(from, to) > 0.2);
    await tab.close();
});

test("the server records what the page plays", async () => {
    const { address, stop } = await serve("view", "place/splats.ply"), tab = await Tab.open(address);
    const picture = await kept(tab);
    await tab.slide("format", "png");
    const [name, bytes] = await tab.saved("record");
    assert.equal(name, "splats.png");
    // The first frame of an animated PNG equals the plain picture; acTL has the number of frames.
    assert.equal(bytes.readUInt32BE(bytes.indexOf("acTL") + 4), 15);
    const alike = psnr(picture, PNG.sync.read(bytes));
    console.log(`first recorded picture: ${alike.toFixed(1)} dB`);
    assert.ok(alike > 56, `${alike} dB`);
    await tab.until(() => /^Recorded 15 pictures/.test(document.getElementById("recorded").textContent));
    if (hasFfmpeg()) {
        await kept(tab);
        await tab.slide("format", "mp4");
        const [name, bytes] = await tab.saved("record");
        assert.ok(name === "splats.mp4" && bytes.subarray(4, 8).toString() === "ftyp", name);
    }
    await tab.screenshot("recorded");
    await tab.press("edit-button");
    await tab.until(() => !document.getElementById("delete").disabled);
    await tab.press("delete");
    await tab.until(() => zipsplat.scene.edits === 1);
    await tab.press("record");
    assert.match(await tab.page.$eval("#recorded", element => element.textContent), /without the edits.* zipsplat render splats.ply /);
    await tab.close();
    await stop();
});

test("a written page says the command that records", async () => {
    const tab = await written(["place/splats.ply"]);
    await kept(tab);
    await tab.slide("format", "gif");
    const [name, bytes] = await tab.saved("record");
    assert.equal(name, "camera_path.json");
    writeFileSync(at(name), bytes);
    const words = await tab.page.$eval("#recorded", element => element.textContent);
    const command = /zipsplat (render splats.spz .*)$/.exec(words);
    assert.ok(command, words);
    writeFileSync(at("splats.spz"), (await tab.saved("save-scene"))[1]);
    zipsplat(...command[1].split(" "));
    assert.equal(readFileSync(at("splats.gif")).subarray(0, 4).toString(), "GIF8");
    await tab.close();
});
