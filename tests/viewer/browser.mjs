// Headless browser with software WebGL2, and pictures of the page and the command.

import assert from "node:assert/strict";
import { execFileSync, spawn } from "node:child_process";
import { mkdirSync, mkdtempSync, readFileSync, rmSync, writeFileSync } from "node:fs";
import { after } from "node:test";
import { tmpdir } from "node:os";
import { join } from "node:path";
import { pathToFileURL } from "node:url";
import { PNG } from "pngjs";
import puppeteer from "puppeteer-core";

const folder = mkdtempSync(join(tmpdir(), "zipsplat-viewer-"));
export const at = name => join(folder, name);
export const zipsplat = (...args) => execFileSync(process.env.ZIPSPLAT, [...args], { cwd: folder, encoding: "utf8", stdio: ["ignore", "pipe", "pipe"] });
export const sleep = ms => new Promise(resolve => setTimeout(resolve, ms));

// Starts a serving command and returns the address it prints.
const servers = new Set();
export async function serve(...args) {
    const child = spawn(process.env.ZIPSPLAT, args, { cwd: folder, stdio: ["ignore", "pipe", "inherit"] });
    servers.add(child);
    let text = "";
    await new Promise(resolve => child.stdout.on("data", part => (text += part).includes("\n") && resolve()));
    const ended = new Promise(resolve => child.on("exit", resolve));
    return { address: text.split("\n")[0], stop: () => (child.kill("SIGINT"), ended) };
}

let browser;
// Ends the browser and any servers that failed tests left running.
after(async () => {
    servers.forEach(child => child.kill("SIGKILL"));
    await browser?.close();
    rmSync(folder, { recursive: true });
});

export class Tab {
    // Opens a page; records its errors and requests.
    static async open(url, viewport = { width: 320, height: 240 }) {
        browser ??= await puppeteer.launch({
            executablePath: process.env.CHROME, protocolTimeout: 600_000,
            args: ["--headless=new", "--no-sandbox", "--enable-unsafe-swiftshader", "--use-angle=swiftshader"],
        });
        const tab = new Tab();
        Object.assign(tab, { complaints: [], requests: [], page: await browser.newPage() });
        tab.page.on("console", message => message.type() === "error" && tab.complaints.push(message.text()));
        tab.page.on("pageerror", error => tab.complaints.push(error.message));
        tab.page.on("request", request => /^(data|blob):/.test(request.url()) || tab.requests.push(request.url()));
        await tab.page.setViewport(viewport);
        await tab.page.goto(url);
        return tab;
    }

    // Sets a slider or a list.
    async slide(id, value) {
        await this.page.$eval(`#${id}`, (element, value) => {
            element.value = value;
            for (const name of ["input", "change"]) element.dispatchEvent(new Event(name));
        }, String(value));
    }

    press(id) { return this.page.$eval(`#${id}`, element => element.click()); }

    // Presses a button and returns the name and bytes of the file that it saves.
    async saved(id) {
        const [name, base64] = await this.run(id => new Promise(resolve => {
            zipsplat.download = async (name, blob) => {
                const bytes = new Uint8Array(await blob.arrayBuffer());
                resolve([name, btoa(Array.from(bytes, byte => String.fromCharCode(byte)).join(""))]);
            };
            document.getElementById(id).click();
        }), id);
        return [name, Buffer.from(base64, "base64")];
    }

    until(holds, timeout = 300_000) { return this.page.waitForFunction(holds, { timeout }); }

    run(code, ...args) { return this.page.evaluate(code, ...args); }
    close() {
        assert.deepEqual(this.complaints, []);
        return this.page.close();
    }

    // Waits until the displayed scene is sorted and drawn.
    async settled() {
        await this.page.waitForFunction(() => {
            const { scene, waiting } = globalThis.zipsplat ?? {};
            return scene?.failed || scene?.drawable?.drawn && !scene.partial && !scene.sorting && !waiting;
        }, { timeout: 300_000 });
    }

    // Returns the page's error message.
    async failure() {
        await this.page.waitForSelector("#message.failed:not([hidden])", { timeout: 120_000 });
        return this.page.$eval("#message", element => element.textContent);
    }

    // Returns the scene's picture at full detail.
    async picture() {
        await this.settled();
        const url = await this.run(() => {
            zipsplat.moved = -1e9;
            zipsplat.draw(performance.now());
            return zipsplat.canvas.toDataURL();
        });
        return PNG.sync.read(Buffer.from(url.split(",")[1], "base64"));
    }

    // Runs `zipsplat render` from the page's camera, through its camera_path.json.
    async rendered(file, ...options) {
        const path = await this.run(() => (zipsplat.path.keys = [], zipsplat.path.keep(), zipsplat.path.file()));
        writeFileSync(at("camera_path.json"), JSON.stringify(path));
        zipsplat("render", file, "--cameras", "camera_path.json", "-o", "pictures", ...options);
        const layers = options.filter(option => /^--[^=]*$/.test(option)).map(option => ({ "--normals": "normal", "--gaussians-per-token": "tokens" })[option] ?? option.slice(2));
        if (layers.length) return layers.map(layer => PNG.sync.read(readFileSync(at(`pictures/000.${layer}.png`)), { skipRescale: true }));
        return PNG.sync.read(readFileSync(at("pictures/000.png")));
    }

    async drop(name, bytes) {
        await this.run((name, base64) => {
            const bytes = Uint8Array.from(atob(base64), c => c.charCodeAt(0)), transfer = new DataTransfer();
            transfer.items.add(new File([bytes], name));
            dispatchEvent(new DragEvent("drop", { dataTransfer: transfer, cancelable: true, bubbles: true }));
        }, name, bytes.toString("base64"));
    }

    async screenshot(name) {
        if (!process.env.PICTURES) return;
        mkdirSync(process.env.PICTURES, { recursive: true });
        await this.page.screenshot({ path: join(process.env.PICTURES, `${name}.png`) });
    }
}

// Opens the written page and waits for its scene.
export async function opened(viewport) {
    const tab = await Tab.open(pathToFileURL(at("page.html")).href, viewport);
    await tab.settled();
    return tab;
}

// Writes a page with the options of `view`, and opens it.
export function written(options, viewport) {
    zipsplat("view", ...options, "-o", "page.html");
    return opened(viewport);
}

export function psnr(a, b) {
    if (a.width !== b.width || a.height !== b.height) throw new Error(`${a.width}x${a.height} beside ${b.width}x${b.height}`);
    let sum = 0, count = 0;
    for (let i = 0; i < a.data.length; ++i) if (i % 4 < 3) sum += (a.data[i] - b.data[i]) ** 2, ++count;
    return 10 * Math.log10(255 ** 2 * count / Math.max(sum, 1e-9));
}

// Returns the spread of a picture's pixels.
export function spread({ data }) {
    const values = [...data].filter((_, i) => i % 4 === 1), mean = values.reduce((a, b) => a + b) / values.length;
    return Math.sqrt(values.reduce((sum, value) => sum + (value - mean) ** 2, 0) / values.length);
}

// Returns a PLY of random Gaussians of degree 3 ahead of the origin, the same on every call.
export function randomPly(count, scales = [-7, -1.5], opacities = [-3, 5], unit = 1) {
    let state = 1;
    const random = (least, most) => {
        state = (state * 48271) % 2147483647;
        return least + (most - least) * state / 2147483647;
    };
    const names = ["x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", ...Array.from({ length: 45 }, (_, i) => `f_rest_${i}`),
        "opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"];
    const header = `ply\nformat binary_little_endian 1.0\nelement vertex ${count}\n${names.map(name => `property float ${name}\n`).join("")}end_header\n`;
    const range = name => /^[xy]$/.test(name) ? [-unit, unit] : name === "z" ? [unit, 4 * unit] : name === "opacity" ? opacities
        : /^scale/.test(name) ? scales : /^f_rest/.test(name) ? [-0.2, 0.2] : [-1, 1];
    const rows = Float32Array.from({ length: count * names.length }, (_, i) => random(...range(names[i % names.length])));
    return Buffer.concat([Buffer.from(header), Buffer.from(rows.buffer)]);
}
