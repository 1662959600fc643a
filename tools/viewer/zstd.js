// Zstandard decompression (RFC 8878), without dictionaries and checksums. Tables map a state to its
// symbol, bit count and, in FSE tables, next base state.

// Extra bits of literal and match length codes; baselines are the previous ends.
const LENGTH_BITS = [
    [...Array(16).fill(0), 1, 1, 1, 1, 2, 2, 3, 3, 4, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15, 16],
    [...Array(32).fill(0), 1, 1, 1, 1, 2, 2, 3, 3, 4, 4, 5, 7, 8, 9, 10, 11, 12, 13, 14, 15, 16],
];
const LENGTHS = LENGTH_BITS.map((all, kind) => {
    let base = 3 * kind;
    return all.map(bits => [(base += 2 ** bits) - 2 ** bits, bits]);
});
// Distributions of literal lengths, offsets and match lengths.
const PREDEFINED = [
    [6, [4, 3, ...Array(11).fill(2), 1, 1, 1, ...Array(9).fill(2), 3, 2, 1, 1, 1, 1, 1, -1, -1, -1, -1]],
    [5, [...Array(6).fill(1), 2, 2, 2, ...Array(15).fill(1), ...Array(5).fill(-1)]],
    [6, [1, 4, 3, ...Array(6).fill(2), ...Array(37).fill(1), ...Array(7).fill(-1)]],
];

const highest = value => 31 - Math.clz32(value);

// Bits of a stream, forward from its first byte or backward from its last set bit. Reads beyond a
// backward stream's start give zeros.
class Bits {
    constructor(bytes, backward = false) {
        this.bytes = bytes;
        this.at = backward ? 8 * bytes.length - 8 + highest(bytes.at(-1)) : 0;
    }

    value(count, at) {
        if (count > 24) return this.value(24, at) + 2 ** 24 * this.value(count - 24, at + 24);
        const { bytes } = this, i = at >> 3;
        return (bytes[i] | bytes[i + 1] << 8 | bytes[i + 2] << 16 | bytes[i + 3] << 24) >>> (at & 7) & (1 << count) - 1;
    }

    read(count) {
        return this.value(count, (this.at += count) - count);
    }

    back(count) {
        this.at -= count;
        return this.at >= 0 ? this.value(count, this.at) : this.value(Math.max(count + this.at, 0), 0) * 2 ** Math.min(-this.at, count);
    }
}

function fseTable(log, counts) {
    const size = 1 << log, table = Array(size), next = counts.map(Math.abs);
    let end = size, at = 0;
    counts.forEach((count, symbol) => count === -1 && (table[--end] = [symbol]));
    counts.forEach((count, symbol) => {
        for (let i = 0; i < count; ++i) {
            table[at] = [symbol];
            do at = at + (size >> 1) + (size >> 3) + 3 & size - 1; while (at >= end);
        }
    });
    for (const entry of table) {
        const state = next[entry[0]]++, bits = log - highest(state);
        entry.push(bits, (state << bits) - size);
    }
    return { log, table };
}

// A table's description and its bytes.
function readFse(bytes) {
    const bits = new Bits(bytes), log = 5 + bits.read(4), counts = [];
    for (let left = 1 << log; left > 0;) {
        const width = highest(left + 1) + 1, threshold = (1 << width) - 2 - left, low = bits.value(width - 1, bits.at);
        let value = low;
        if (low < threshold) bits.read(width - 1);
        else if ((value = bits.read(width)) >= 1 << width - 1) value -= threshold;
        counts.push(value - 1);
        left -= Math.abs(value - 1);
        if (value === 1) {
            let zeros;
            do counts.push(...Array(zeros = bits.read(2)).fill(0)); while (zeros === 3);
        }
    }
    return [fseTable(log, counts), bits.at + 7 >> 3];
}

function huffmanWeights(bytes) {
    const [table, used] = readFse(bytes), bits = new Bits(bytes.subarray(used), true), weights = [];
    const states = [bits.back(table.log), bits.back(table.log)];
    for (let k = 0; ; k = 1 - k) {
        const [symbol, count, base] = table.table[states[k]];
        weights.push(symbol);
        states[k] = base + bits.back(count);
        if (bits.at < 0) return [...weights, table.table[states[1 - k]][0]];
    }
}

function readHuffman(bytes) {
    const head = bytes[0], used = head < 128 ? 1 + head : 1 + (head - 126 >> 1);
    const weights = head < 128 ? huffmanWeights(bytes.subarray(1, used)) :
        Array.from({ length: head - 127 }, (_, i) => bytes[1 + (i >> 1)] >> (i % 2 ? 0 : 4) & 15);
    const sum = weights.reduce((sum, weight) => sum + (weight && 1 << weight - 1), 0), log = highest(sum) + 1;
    weights.push(highest((1 << log) - sum) + 1);
    const table = [];
    for (let weight = 1; weight <= log; ++weight) weights.forEach((own, symbol) => {
        if (own === weight) table.push(...Array(1 << weight - 1).fill([symbol, log + 1 - weight]));
    });
    return [{ log, table }, used];
}

function huffmanStream({ log, table }, bytes, out) {
    const bits = new Bits(bytes, true);
    let state = bits.back(log);
    for (let i = 0; i < out.length; ++i) {
        const [symbol, count] = table[state];
        out[i] = symbol;
        state = (state << count & (1 << log) - 1) + bits.back(count);
    }
}

// A block's literals and their bytes.
function readLiterals(bytes, tables) {
    const type = bytes[0] & 3, format = bytes[0] >> 2 & 3, bits = new Bits(bytes);
    if (type < 2) {
        const head = [1, 2, 1, 3][format];
        bits.at = format % 2 ? 4 : 3;
        const count = bits.read(8 * head - bits.at), used = head + (type ? 1 : count);
        return [type ? new Uint8Array(count).fill(bytes[head]) : bytes.subarray(head, used), used];
    }
    bits.at = 4;
    const width = [10, 10, 14, 18][format], count = bits.read(width), packed = bits.read(width), head = bits.at + 7 >> 3;
    let body = bytes.subarray(head, head + packed);
    if (type === 2) {
        const [table, used] = readHuffman(body);
        [tables.huffman, body] = [table, body.subarray(used)];
    }
    const literals = new Uint8Array(count), streams = format ? 4 : 1, part = format ? count + 3 >> 2 : count;
    for (let i = 0, at = format ? 6 : 0; i < streams; ++i) {
        const end = i + 1 < streams ? at + body[2 * i] + 256 * body[2 * i + 1] : body.length;
        huffmanStream(tables.huffman, body.subarray(at, end), literals.subarray(i * part, Math.min((i + 1) * part, count)));
        at = end;
    }
    return [literals, head + packed];
}

// Returns the new length of `out`.
function runBlock(bytes, tables, history, out, length) {
    const [literals, start] = readLiterals(bytes, tables), head = bytes[start];
    let at = start + 1, count = head, taken = 0;
    if (head > 127) count = head < 255 ? (head - 128) * 256 + bytes[at++] : bytes[at++] + 256 * bytes[at++] + 0x7f00;
    if (count) {
        const modes = bytes[at++];
        for (let kind = 0; kind < 3; ++kind) {
            const mode = modes >> 6 - 2 * kind & 3;
            if (mode === 0) tables[kind] = fseTable(...PREDEFINED[kind]);
            if (mode === 1) tables[kind] = { log: 0, table: [[bytes[at++], 0, 0]] };
            if (mode === 2) {
                const [table, used] = readFse(bytes.subarray(at));
                [tables[kind], at] = [table, at + used];
            }
        }
        const bits = new Bits(bytes.subarray(at), true), states = [0, 1, 2].map(kind => bits.back(tables[kind].log));
        for (let i = 0; i < count; ++i) {
            const [own, offset, match] = states.map((state, kind) => tables[kind].table[state]);
            const value = 2 ** offset[0] + bits.back(offset[0]);
            const [matchBase, matchBits] = LENGTHS[1][match[0]], matched = matchBase + bits.back(matchBits);
            const [base, extra] = LENGTHS[0][own[0]], copied = base + bits.back(extra);
            if (i + 1 < count) for (const [kind, [, width, next]] of [[0, own], [2, match], [1, offset]]) states[kind] = next + bits.back(width);
            const repeat = value > 3 ? 3 : value - (copied ? 1 : 0);
            const distance = value > 3 ? value - 3 : repeat === 3 ? history[0] - 1 : history[repeat];
            if (repeat) history.splice(0, 3, distance, history[0], history[repeat === 1 ? 2 : 1]);
            out.set(literals.subarray(taken, taken += copied), length);
            length += copied;
            if (distance > length) throw new Error("zstd");
            for (const end = length + matched; length < end; ++length) out[length] = out[length - distance];
        }
    }
    out.set(literals.subarray(taken), length);
    return length + literals.length - taken;
}

function unzstd(bytes, size) {
    const head = bytes[4], single = head >> 5 & 1, out = new Uint8Array(size), tables = {}, history = [1, 4, 8];
    if (bytes[0] !== 0x28 || bytes[1] !== 0xb5 || bytes[2] !== 0x2f || bytes[3] !== 0xfd) throw new Error("zstd");
    let at = 6 - single + [0, 1, 2, 4][head & 3] + [single, 2, 4, 8][head >> 6], length = 0, last = 0;
    while (!last) {
        const block = bytes[at] + 256 * bytes[at + 1] + 65536 * bytes[at + 2], count = block >> 3, type = block >> 1 & 3;
        last = block & 1;
        at += 3;
        const end = at + (type === 1 ? 1 : count), body = bytes.subarray(at, end);
        if (!(end <= bytes.length)) throw new Error("zstd");
        if (type === 2) length = runBlock(body, tables, history, out, length);
        else {
            if (type) out.fill(body[0], length, length + count);
            else out.set(body, length);
            length += count;
        }
        at = end;
    }
    if (length !== size) throw new Error("zstd");
    return out;
}
