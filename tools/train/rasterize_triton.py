"""Blending on GPUs: one warp per tile of 8 x 8 pixels, chunks of Gaussians front to back."""

import torch
import triton
import triton.language as tl

from splats import MAX_ALPHA, MIN_ALPHA, MIN_TRANSMITTANCE, SPLAT, depth_order

TILE = tl.constexpr(8)
# Gaussians that a program blends, and scans for its list, per iteration.
CHUNK = 8
SCAN = 256
SPLAT = tl.constexpr(SPLAT)
MAX_ALPHA = tl.constexpr(MAX_ALPHA)
MIN_ALPHA = tl.constexpr(MIN_ALPHA)
MIN_TRANSMITTANCE = tl.constexpr(MIN_TRANSMITTANCE)


def blend(splats, bounds, size):
    """Planes [P, 5, H, W] (r, g, b, depth, alpha) and `reached` [P, N]."""
    return Blend.apply(splats, bounds, size)


class Blend(torch.autograd.Function):
    @staticmethod
    def forward(ctx, splats, bounds, size):
        splats = splats.contiguous()
        pictures, n = splats.shape[:2]
        height, width = size
        grid = (triton.cdiv(width, TILE.value) * triton.cdiv(height, TILE.value), pictures)
        order = depth_order(splats)
        # Capacity for every Gaussian in every tile: avoids a readback of counts.
        lists = torch.empty(pictures, grid[0], n, dtype=torch.int32, device=splats.device)
        counts = torch.empty(pictures, grid[0], dtype=torch.int32, device=splats.device)
        planes = splats.new_empty(pictures, 5, height, width)
        reached = torch.zeros(pictures, n, dtype=torch.int8, device=splats.device)
        list_kernel[grid](bounds.contiguous(), order, lists, counts, n, width, SCAN)
        forward_kernel[grid](splats, lists, counts, planes, reached, n, height, width, CHUNK, num_warps=1)
        ctx.save_for_backward(splats, lists, counts, planes)
        reached = reached.bool()
        ctx.mark_non_differentiable(reached)
        return planes, reached

    @staticmethod
    def backward(ctx, grad, _):
        splats, lists, counts, planes = ctx.saved_tensors
        height, width = planes.shape[2:]
        grad_splats = torch.zeros_like(splats)
        grid = (counts.shape[1], counts.shape[0])
        backward_kernel[grid](
            splats,
            lists,
            counts,
            planes,
            grad.contiguous(),
            grad_splats,
            splats.shape[1],
            height,
            width,
            CHUNK,
            num_warps=1,
        )
        return grad_splats, None, None


@triton.jit
def list_kernel(bounds, order, lists, counts, n, width, SCAN: tl.constexpr):
    """Lists the Gaussians whose bounds meet the program's tile, near to far."""
    tile, picture = tl.program_id(0), tl.program_id(1).to(tl.int64)
    tiles_x = tl.cdiv(width, TILE)
    x0, y0 = tile % tiles_x * TILE, tile // tiles_x * TILE
    entry = picture * tl.num_programs(0) + tile
    count = 0
    for start in range(0, n, SCAN):
        i = start + tl.arange(0, SCAN)
        inside = i < n
        g = tl.load(order + picture * n + i, mask=inside, other=0)
        row = bounds + (picture * n + g) * 4
        low_x = tl.load(row, mask=inside, other=0)
        low_y = tl.load(row + 1, mask=inside, other=0)
        high_x = tl.load(row + 2, mask=inside, other=0)
        high_y = tl.load(row + 3, mask=inside, other=0)
        meets = (high_x > low_x) & (low_x < x0 + TILE) & (high_x > x0)
        meets = meets & (high_y > low_y) & (low_y < y0 + TILE) & (high_y > y0)
        slot = count + tl.cumsum(meets.to(tl.int32), 0) - 1
        tl.store(lists + entry * n + slot, g, mask=meets)
        count += tl.sum(meets.to(tl.int32), 0)
    tl.store(counts + entry, count)


@triton.jit
def multiply(a, b):
    return a * b


@triton.jit
def chunk_alpha(row, present, x, y):
    """[CHUNK, pixels] alpha, and inputs of its gradient: dx, dy and the conic."""
    dx = tl.load(row, mask=present, other=0.0)[:, None] - x[None, :]
    dy = tl.load(row + 1, mask=present, other=0.0)[:, None] - y[None, :]
    a = tl.load(row + 2, mask=present, other=1.0)
    b = tl.load(row + 3, mask=present, other=0.0)
    c = tl.load(row + 4, mask=present, other=1.0)
    opacity = tl.load(row + 5, mask=present, other=0.0)
    sigma = 0.5 * (a[:, None] * dx * dx + c[:, None] * dy * dy) + b[:, None] * dx * dy
    alpha = tl.minimum(opacity[:, None] * tl.exp(-sigma), MAX_ALPHA)
    alpha = tl.where((sigma >= 0) & (alpha >= MIN_ALPHA), alpha, 0.0)
    return alpha, dx, dy, a, b, c, opacity


@triton.jit
def forward_kernel(splats, lists, counts, planes, reached, n, height, width, CHUNK: tl.constexpr):
    tile, picture = tl.program_id(0), tl.program_id(1).to(tl.int64)
    tiles_x = tl.cdiv(width, TILE)
    pixel = tl.arange(0, TILE * TILE)
    column, line = tile % tiles_x * TILE + pixel % TILE, tile // tiles_x * TILE + pixel // TILE
    inside = (column < width) & (line < height)
    x, y = column + 0.5, line + 0.5
    entry = picture * tl.num_programs(0) + tile
    count = tl.load(counts + entry)

    # 0 in finished pixels.
    transmittance = tl.where(inside, 1.0, 0.0)
    red = tl.zeros([TILE * TILE], tl.float32)
    green = tl.zeros([TILE * TILE], tl.float32)
    blue = tl.zeros([TILE * TILE], tl.float32)
    depth = tl.zeros([TILE * TILE], tl.float32)
    opaque = tl.zeros([TILE * TILE], tl.float32)
    start = 0
    while start < count:
        i = start + tl.arange(0, CHUNK)
        present = i < count
        g = tl.load(lists + entry * n + i, mask=present, other=0)
        row = splats + (picture * n + g) * SPLAT
        alpha, _, _, _, _, _, _ = chunk_alpha(row, present, x, y)
        after = transmittance[None, :] * tl.associative_scan(1.0 - alpha, 0, multiply)
        weight = tl.where(after > MIN_TRANSMITTANCE, alpha * after / (1.0 - alpha), 0.0)
        red += tl.sum(weight * tl.load(row + 6, mask=present, other=0.0)[:, None], 0)
        green += tl.sum(weight * tl.load(row + 7, mask=present, other=0.0)[:, None], 0)
        blue += tl.sum(weight * tl.load(row + 8, mask=present, other=0.0)[:, None], 0)
        depth += tl.sum(weight * tl.load(row + 9, mask=present, other=0.0)[:, None], 0)
        opaque += tl.sum(weight, 0)
        # Tiles race with the same value.
        tl.store(reached + picture * n + g, 1, mask=present & (tl.max(weight, 1) > MIN_ALPHA))
        last = tl.min(after, 0)
        transmittance = tl.where(last > MIN_TRANSMITTANCE, last, 0.0)
        start = tl.where(tl.max(transmittance, 0) > 0, start + CHUNK, count)

    plane = height * width
    out = planes + picture * 5 * plane + line * width + column
    tl.store(out, red, mask=inside)
    tl.store(out + plane, green, mask=inside)
    tl.store(out + 2 * plane, blue, mask=inside)
    tl.store(out + 3 * plane, depth, mask=inside)
    tl.store(out + 4 * plane, opaque, mask=inside)


@triton.jit
def backward_kernel(splats, lists, counts, planes, grad, grad_splats, n, height, width, CHUNK: tl.constexpr):
    """Front to back: the color behind a Gaussian is the total minus the sum up to it."""
    tile, picture = tl.program_id(0), tl.program_id(1).to(tl.int64)
    tiles_x = tl.cdiv(width, TILE)
    pixel = tl.arange(0, TILE * TILE)
    column, line = tile % tiles_x * TILE + pixel % TILE, tile // tiles_x * TILE + pixel // TILE
    inside = (column < width) & (line < height)
    x, y = column + 0.5, line + 0.5
    entry = picture * tl.num_programs(0) + tile
    count = tl.load(counts + entry)

    plane = height * width
    place = picture * 5 * plane + line * width + column
    grad_r = tl.load(grad + place, mask=inside, other=0.0)
    grad_g = tl.load(grad + place + plane, mask=inside, other=0.0)
    grad_b = tl.load(grad + place + 2 * plane, mask=inside, other=0.0)
    grad_z = tl.load(grad + place + 3 * plane, mask=inside, other=0.0)
    grad_a = tl.load(grad + place + 4 * plane, mask=inside, other=0.0)
    behind = grad_r * tl.load(planes + place, mask=inside, other=0.0)
    behind += grad_g * tl.load(planes + place + plane, mask=inside, other=0.0)
    behind += grad_b * tl.load(planes + place + 2 * plane, mask=inside, other=0.0)
    behind += grad_z * tl.load(planes + place + 3 * plane, mask=inside, other=0.0)
    behind += grad_a * tl.load(planes + place + 4 * plane, mask=inside, other=0.0)

    transmittance = tl.where(inside, 1.0, 0.0)
    start = 0
    while start < count:
        i = start + tl.arange(0, CHUNK)
        present = i < count
        g = tl.load(lists + entry * n + i, mask=present, other=0)
        row = splats + (picture * n + g) * SPLAT
        alpha, dx, dy, a, b, c, opacity = chunk_alpha(row, present, x, y)
        after = transmittance[None, :] * tl.associative_scan(1.0 - alpha, 0, multiply)
        alive = after > MIN_TRANSMITTANCE
        before = after / (1.0 - alpha)
        weight = tl.where(alive, alpha * before, 0.0)
        value = (
            tl.load(row + 6, mask=present, other=0.0)[:, None] * grad_r[None, :]
            + tl.load(row + 7, mask=present, other=0.0)[:, None] * grad_g[None, :]
            + tl.load(row + 8, mask=present, other=0.0)[:, None] * grad_b[None, :]
            + tl.load(row + 9, mask=present, other=0.0)[:, None] * grad_z[None, :]
            + grad_a[None, :]
        )
        part = weight * value
        beyond = behind[None, :] - tl.cumsum(part, 0)
        d_sigma = -alpha * (before * value - beyond / (1.0 - alpha))
        d_sigma = tl.where(alive & (alpha < MAX_ALPHA), d_sigma, 0.0)
        behind -= tl.sum(part, 0)

        moment_x, moment_y = tl.sum(d_sigma * dx, 1), tl.sum(d_sigma * dy, 1)
        out = grad_splats + (picture * n + g) * SPLAT
        tl.atomic_add(out, a * moment_x + b * moment_y, mask=present)
        tl.atomic_add(out + 1, b * moment_x + c * moment_y, mask=present)
        tl.atomic_add(out + 2, 0.5 * tl.sum(d_sigma * dx * dx, 1), mask=present)
        tl.atomic_add(out + 3, tl.sum(d_sigma * dx * dy, 1), mask=present)
        tl.atomic_add(out + 4, 0.5 * tl.sum(d_sigma * dy * dy, 1), mask=present)
        tl.atomic_add(out + 5, -tl.sum(d_sigma, 1) / tl.where(present, opacity, 1.0), mask=present)
        tl.atomic_add(out + 6, tl.sum(weight * grad_r[None, :], 1), mask=present)
        tl.atomic_add(out + 7, tl.sum(weight * grad_g[None, :], 1), mask=present)
        tl.atomic_add(out + 8, tl.sum(weight * grad_b[None, :], 1), mask=present)
        tl.atomic_add(out + 9, tl.sum(weight * grad_z[None, :], 1), mask=present)
        last = tl.min(after, 0)
        transmittance = tl.where(last > MIN_TRANSMITTANCE, last, 0.0)
        start = tl.where(tl.max(transmittance, 0) > 0, start + CHUNK, count)
