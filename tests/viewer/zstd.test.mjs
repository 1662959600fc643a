import assert from "node:assert/strict";
import { execFileSync, spawnSync } from "node:child_process";
import { readFileSync } from "node:fs";
import { test } from "node:test";
import { runInNewContext } from "node:vm";

const source = readFileSync(new URL("../../tools/viewer/zstd.js", import.meta.url), "utf8");
const { unzstd } = runInNewContext(`${source}\n({ unzstd });`, { Uint8Array });
const missing = spawnSync("zstd", ["--version"]).error && "found no zstd";

function contents() {
    let state = 1;
    const random = below => (state = (state * 48271) % 0x7fffffff) % below;
    const words = Array.from({ length: 60_000 }, () => ["hello ", "world ", String.fromCharCode(random(128))][random(3)]);
    return {
        one: Buffer.from("x"), zeros: Buffer.alloc(300_000), random: Buffer.from(Array.from({ length: 200_000 }, () => random(256))),
        words: Buffer.from(words.join("")), source: Buffer.from(source), floats: Buffer.from(new Float32Array(50_000).map((_, i) => Math.sin(i / 9)).buffer),
    };
}

test("frames of every level are decompressed", { skip: missing }, () => {
    for (const [name, plain] of Object.entries(contents()))
        for (const level of ["--fast=5", "-1", "-3", "-9", "-19"]) {
            const packed = execFileSync("zstd", ["-q", "-c", level], { input: plain, maxBuffer: 1 << 26 });
            assert.ok(plain.equals(unzstd(packed, plain.length)), `${name} ${level}`);
        }
});

test("damaged frames are refused", { skip: missing }, () => {
    const plain = contents().words, packed = execFileSync("zstd", ["-q", "-c"], { input: plain });
    for (const [bytes, size] of [[packed.subarray(0, 5000), plain.length], [packed, plain.length - 1], [packed, plain.length + 1], [Buffer.from("no frame"), 8]])
        assert.throws(() => unzstd(bytes, size));
});
