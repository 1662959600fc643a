"""Blending on CPUs: one thread per picture, front to back, pixels inside each ellipse."""

import math

import numba
import numpy as np
import torch

from splats import MAX_ALPHA, MIN_ALPHA, MIN_TRANSMITTANCE, SPLAT, depth_order

# OpenMP's spinning threads slow down other processes.
numba.config.THREADING_LAYER = "workqueue"

F = np.float32
MAX_ALPHA, MIN_ALPHA, MIN_TRANSMITTANCE = F(MAX_ALPHA), F(MIN_ALPHA), F(MIN_TRANSMITTANCE)


def blend(splats, bounds, size):
    """Planes [P, 5, H, W] (r, g, b, depth, alpha) and `reached` [P, N]."""
    return Blend.apply(splats, bounds, size)


class Blend(torch.autograd.Function):
    @staticmethod
    def forward(ctx, splats, bounds, size):
        splats = splats.contiguous()
        order = depth_order(splats)
        planes = splats.new_zeros(splats.shape[0], 5, *size)
        reached = torch.zeros(splats.shape[:2], dtype=torch.bool)
        numba.set_num_threads(min(torch.get_num_threads(), numba.config.NUMBA_NUM_THREADS))
        forward(*(x.detach().numpy() for x in (splats, bounds, order, planes, reached)))
        ctx.save_for_backward(splats, bounds, order, planes)
        ctx.mark_non_differentiable(reached)
        return planes, reached

    @staticmethod
    def backward(ctx, grad, _):
        saved = ctx.saved_tensors
        grad_splats = torch.zeros_like(saved[0])
        backward(*(x.detach().numpy() for x in (*saved, grad.contiguous(), grad_splats)))
        return grad_splats, None, None


@numba.njit(inline="always")
def span(a, b, c, mean_x, dy, limit, x0, x1):
    """Pixels of a row with sigma <= limit, half a pixel wider on each side."""
    # a / 2 dx^2 + b dy dx + c / 2 dy^2 - limit = 0
    linear = b * dy
    discriminant = linear * linear - a * (c * dy * dy - F(2) * limit)
    if discriminant < 0:
        return 0, 0
    root = math.sqrt(discriminant)
    low = mean_x + (linear - root) / a
    high = mean_x + (linear + root) / a
    return max(x0, int(math.floor(low - F(1)))), min(x1, int(math.ceil(high + F(1))))


@numba.njit(parallel=True, fastmath=True, cache=True)
def forward(splats, bounds, order, planes, reached):
    height, width = planes.shape[2:]
    for p in numba.prange(splats.shape[0]):
        transmittance = np.ones((height, width), F)
        for i in range(order.shape[1]):
            g = order[p, i]
            x0, y0, x1, y1 = bounds[p, g]
            mean_x, mean_y, a, b, c, opacity, red, green, blue, depth = splats[p, g]
            if x0 >= x1 or y0 >= y1:
                continue
            limit = F(math.log(opacity / MIN_ALPHA))
            for y in range(y0, y1):
                dy = mean_y - (F(y) + F(0.5))
                start, end = span(a, b, c, mean_x, dy, limit, x0, x1)
                for x in range(start, end):
                    before = transmittance[y, x]
                    dx = mean_x - (F(x) + F(0.5))
                    sigma = F(0.5) * (a * dx * dx + c * dy * dy) + b * dx * dy
                    alpha = min(MAX_ALPHA, opacity * F(math.exp(-sigma)))
                    if before == 0 or sigma < 0 or alpha < MIN_ALPHA:
                        continue
                    after = before * (F(1) - alpha)
                    if after <= MIN_TRANSMITTANCE:
                        transmittance[y, x] = 0
                        continue
                    weight = alpha * before
                    planes[p, 0, y, x] += weight * red
                    planes[p, 1, y, x] += weight * green
                    planes[p, 2, y, x] += weight * blue
                    planes[p, 3, y, x] += weight * depth
                    planes[p, 4, y, x] += weight
                    transmittance[y, x] = after
                    if weight > MIN_ALPHA:
                        reached[p, g] = True


@numba.njit(parallel=True, fastmath=True, cache=True)
def backward(splats, bounds, order, planes, grad, grad_splats):
    """Front to back: the color behind a Gaussian is the total minus the sum up to it."""
    height, width = planes.shape[2:]
    for p in numba.prange(splats.shape[0]):
        transmittance = np.ones((height, width), F)
        behind = np.zeros((height, width), F)
        for channel in range(5):
            behind += planes[p, channel] * grad[p, channel]
        for i in range(order.shape[1]):
            g = order[p, i]
            x0, y0, x1, y1 = bounds[p, g]
            mean_x, mean_y, a, b, c, opacity, red, green, blue, depth = splats[p, g]
            if x0 >= x1 or y0 >= y1:
                continue
            limit = F(math.log(opacity / MIN_ALPHA))
            # Moments of d loss / d sigma about the mean, channel sums of weight times gradient.
            m0 = mx = my = mxx = mxy = myy = vr = vg = vb = vz = F(0)
            for y in range(y0, y1):
                dy = mean_y - (F(y) + F(0.5))
                start, end = span(a, b, c, mean_x, dy, limit, x0, x1)
                for x in range(start, end):
                    before = transmittance[y, x]
                    dx = mean_x - (F(x) + F(0.5))
                    sigma = F(0.5) * (a * dx * dx + c * dy * dy) + b * dx * dy
                    alpha = min(MAX_ALPHA, opacity * F(math.exp(-sigma)))
                    if before == 0 or sigma < 0 or alpha < MIN_ALPHA:
                        continue
                    after = before * (F(1) - alpha)
                    if after <= MIN_TRANSMITTANCE:
                        transmittance[y, x] = 0
                        continue
                    transmittance[y, x] = after
                    weight = alpha * before
                    gr, gg, gb = grad[p, 0, y, x], grad[p, 1, y, x], grad[p, 2, y, x]
                    gz, ga = grad[p, 3, y, x], grad[p, 4, y, x]
                    value = red * gr + green * gg + blue * gb + depth * gz + ga
                    behind[y, x] -= weight * value
                    vr += weight * gr
                    vg += weight * gg
                    vb += weight * gb
                    vz += weight * gz
                    if alpha < MAX_ALPHA:
                        d_sigma = -alpha * (before * value - behind[y, x] / (F(1) - alpha))
                        m0 += d_sigma
                        mx += d_sigma * dx
                        my += d_sigma * dy
                        mxx += d_sigma * dx * dx
                        mxy += d_sigma * dx * dy
                        myy += d_sigma * dy * dy
            out = grad_splats[p, g]
            out[0] = a * mx + b * my
            out[1] = b * mx + c * my
            out[2] = F(0.5) * mxx
            out[3] = mxy
            out[4] = F(0.5) * myy
            out[5] = -m0 / opacity
            out[6], out[7], out[8], out[9] = vr, vg, vb, vz


assert SPLAT == 10, "the kernels unpack ten values"
