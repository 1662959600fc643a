"""Prints kernels of matrix units in RADV's log of test-radv.sh, with their inner loops.

usage: matrix_shares.py LOG FAMILY      with RADV_DEBUG=shaders,shaderstats

share: clocks of matrix products among those of all vector instructions of the loop, with every
branch. ACO: clocks of matrix products over the compiler's inverse throughput, which counts a loop
eightfold. Both bound the share of the matrix units' peak that other subgroups can fill. FLOP per byte
of shared memory and of L2 follow from the tile on any device, for factors of 2 bytes.
"""

import re
import sys

CLOCKS = 32  # of a subgroup's product of 16 x 16 x 16; RDNA 4 needs half
KINDS = {"v_wmma": "wmma", "v_": "vector", "ds_": "shared", "buffer_": "global", "global_": "global",
         "s_waitcnt": "waits", "s_wait_": "waits", "s_barrier": "barriers"}
STATS = {"VGPRs": "registers", "Spilled VGPRs": "spilled", "LDS size": "bytes", "Subgroups per SIMD": "subgroups"}


def loops_of(code):
    """Returns the first and last line of each loop."""
    places, loops = {}, {}
    for i, line in enumerate(code):
        if label := re.match(r"(BB\d+):", line):
            places[label[1]] = i
        elif (jump := re.match(r"\ts_c?branch\w* (BB\d+)", line)) and jump[1] in places:
            loops[places[jump[1]]] = i
    return loops.items()


def products(code):
    """Counts matrix products, those of a loop eightfold."""
    places = [i for i, line in enumerate(code) if line.startswith("\tv_wmma")]
    return sum(8 ** sum(first < i < last for first, last in loops_of(code)) for i in places)


def inner_loop(code):
    """Counts instructions by kind in the shortest loop with matrix products."""
    bodies = sorted((code[first:last] for first, last in loops_of(code)), key=len)
    bodies = [lines for lines in bodies if any("\tv_wmma" in line for line in lines)]
    counts = dict.fromkeys(KINDS.values(), 0)
    for line in bodies[0] if bodies else []:
        kind = next((kind for start, kind in KINDS.items() if line.startswith(f"\t{start}")), None)
        if kind:
            counts[kind] += 1
    return counts


def tile(kernel, constant):
    """Returns a tile's name, and FLOP per byte of shared memory and of L2 for 2-byte factors."""
    m, n = constant[2], constant[3]
    if "attention" in kernel:
        rows, keys, channels = constant[5] * m, constant[6], constant[7]
        queries = constant[1] * rows
        name = f"{queries} queries of {channels}, {keys} keys"
        return name, rows * channels / (channels + rows), queries
    along = [constant[1] // constant[5], constant[5]]
    sides = [constant[6] * m, constant[7] * n]
    whole = [count * side for count, side in zip(along, sides)]
    name = f"{whole[0]}x{whole[1]}, k {constant[8]}"
    return name, *(a * b / (a + b) for a, b in (sides, whole))


def main():
    text, family = open(sys.argv[1], errors="replace").read(), sys.argv[2]
    clocks = CLOCKS // 2 if family.startswith("gfx12") else CLOCKS
    rows = set()
    for part in text.split("\nPIPELINE ")[1:]:
        kernel, *constants = part.split("\n", 1)[0].split()
        if not re.search(r"(linear|attention|nearest)_matrix", kernel) or "\ndisasm:" not in part:
            continue
        code = part.split("\ndisasm:\n")[1].split("\n")
        loop = inner_loop(code)
        stats = {name: re.search(rf"^{key}: (\d+)", part, re.M)[1] for key, name in STATS.items()}
        constant = {int(key): int(value) for key, value in (pair.split("=") for pair in constants)}
        name, shared, l2 = tile(kernel, constant)
        busy = clocks * loop["wmma"]
        passes = constant[0] // constant[1] // 32  # of a vector instruction, a clock each
        share = busy / max(1, busy + passes * loop["vector"])
        aco = clocks * products(code) / int(re.search(r"^Inverse Throughput: (\d+)", part, re.M)[1])
        rows.add((kernel.removesuffix(".spv"), name, *stats.values(), *loop.values(), f"{share:.0%}",
                  f"{aco:.0%}", f"{shared:.0f}", f"{l2:.0f}"))
    head = ["kernel", "tile", *STATS.values(), *dict.fromkeys(KINDS.values()), "share", "ACO", "FLOP/B shared", "FLOP/B L2"]
    for row in [head, ["---"] * len(head), *sorted(rows)]:
        print(f"| {' | '.join(map(str, row))} |")


main()
