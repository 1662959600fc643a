"""Differentiable batch rendering by the rules of gsplat 1.5.3 (classic mode), like the engine's.

Projection is PyTorch. Blending is Triton on GPUs, numba on CPUs, and plain PyTorch (every Gaussian
at every pixel) as the reference in tests.

Shapes: B scenes, C cameras a scene, N Gaussians, P = B * C pictures.
"""

from collections import namedtuple

import torch

from splats import BLUR, MAX_ALPHA, MIN_ALPHA, MIN_TRANSMITTANCE, NEAR, depth_order

Pictures = namedtuple("Pictures", "rgb alpha depth reached")


def rasterize(gaussians, viewmats, intrinsics, size, sh_degree=1, blend=None):
    """Renders Gaussians [B, N, 11 + 3K], viewmats [B, C, 4, 4], intrinsics [B, C, 4] fx fy cx cy.

    Returns rgb [B, C, H, W, 3], alpha [B, C, H, W], depth (not divided by alpha), and `reached`
    [B, N]: Gaussians with a weight above 1/255 in a pixel.
    """
    splats, bounds = project(gaussians, viewmats, intrinsics, size, sh_degree)
    blend = blend or default_blend(gaussians.device)
    planes, reached = blend(splats.flatten(0, 1), bounds.flatten(0, 1), size)
    planes = planes.unflatten(0, splats.shape[:2])
    reached = reached.unflatten(0, splats.shape[:2]).any(1)
    return Pictures(planes[:, :, :3].movedim(2, -1), planes[:, :, 4], planes[:, :, 3], reached)


def default_blend(device):
    if device.type == "cuda":
        from rasterize_triton import blend
    else:
        from rasterize_numba import blend
    return blend


def project(gaussians, viewmats, intrinsics, size, sh_degree):
    """Splats [B, C, N, 10] and pixel bounds [B, C, N, 4] i32: x0, y0, x1, y1 (exclusive)."""
    height, width = size
    means, scales, quats, opacity, sh = gaussians.split((3, 3, 4, 1, gaussians.shape[-1] - 11), -1)
    rotation, translation = viewmats[..., :3, :3], viewmats[..., :3, 3]
    fx, fy, cx, cy = intrinsics[:, :, None].unbind(-1)

    camera = torch.einsum("bcij,bnj->bcni", rotation, means) + translation[:, :, None]
    x, y, depth = camera.unbind(-1)
    visible = depth >= NEAR
    z = torch.where(visible, depth, 1)
    u, v = x / z, y / z
    # The Jacobian is clamped to 15 % beyond the picture.
    margin_x, margin_y = 0.15 * width / fx, 0.15 * height / fy
    u_near = u.clamp(-(cx / fx + margin_x), (width - cx) / fx + margin_x)
    v_near = v.clamp(-(cy / fy + margin_y), (height - cy) / fy + margin_y)

    # Ellipsoid axes in camera space [B, C, N, 3 (space), 3 (axes)], then projected.
    axes = torch.einsum("bcij,bnjk->bcnik", rotation, rotations(quats) * scales[..., None, :])
    axis_x = (fx / z)[..., None] * (axes[..., 0, :] - u_near[..., None] * axes[..., 2, :])
    axis_y = (fy / z)[..., None] * (axes[..., 1, :] - v_near[..., None] * axes[..., 2, :])
    var_x, var_y = (axis_x**2).sum(-1) + BLUR, (axis_y**2).sum(-1) + BLUR
    covariance = (axis_x * axis_y).sum(-1)
    det = var_x * var_y - covariance**2
    conic = torch.stack((var_y, -covariance, var_x), -1) / det[..., None]

    mean = torch.stack((fx * u + cx, fy * v + cy), -1)
    opacity = opacity[:, None, :, 0].expand_as(z)
    color = shade(sh, means[:, None] + rotation.mT.matmul(translation[..., None]).mT, sh_degree)
    splats = torch.cat((mean, conic, opacity[..., None], color, depth[..., None]), -1)
    with torch.no_grad():
        visible = visible & (opacity >= MIN_ALPHA) & (det > 0)
        sigmas = (2 * (255 * opacity.clamp_min(MIN_ALPHA)).log()).sqrt().clamp_max(3.33)
        reach = (sigmas[..., None] * torch.stack((var_x, var_y), -1).sqrt()).ceil()
        low, high = (
            torch.stack((bound[..., 0].clamp(0, width), bound[..., 1].clamp(0, height)), -1)
            for bound in ((mean - reach).floor(), (mean + reach).ceil())
        )
        high = torch.where(visible[..., None] & high.isfinite() & low.isfinite(), high, 0)
        bounds = torch.cat((low.nan_to_num(0), high), -1).int()
    return splats, bounds


def rotations(quats):
    """[..., 4] wxyz, of any length, -> [..., 3, 3]"""
    w, x, y, z = (quats / quats.norm(dim=-1, keepdim=True)).unbind(-1)
    rows = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )
    return torch.stack([torch.stack(row, -1) for row in rows], -2)


def shade(sh, directions, sh_degree):
    """Colors [B, C, N, 3] of [B, N, K * 3]; `directions` [B, C, N, 3] have any length."""
    if sh_degree > 1:
        raise ValueError(f"found SH degree {sh_degree}, training knows 0 and 1")
    sh = sh.unflatten(-1, (-1, 3))[:, None]
    color = 0.5 + 0.2820947917738781 * sh[..., 0, :]
    if sh_degree == 1:
        x, y, z = (directions / directions.norm(dim=-1, keepdim=True)).split(1, -1)
        color = color + 0.48860251190292 * (z * sh[..., 2, :] - y * sh[..., 1, :] - x * sh[..., 3, :])
    else:
        color = color.expand_as(directions)
    return color.clamp_min(0)


def blend_plain(splats, bounds, size):
    """Planes [P, 5, H, W] (r, g, b, depth, alpha) and `reached` [P, N], all pairs."""
    height, width = size
    y, x = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij")
    pixels = torch.stack((x, y), -1).flatten(0, 1).to(splats)
    planes, reached = [], []
    for rows, limits, order in zip(splats, bounds, depth_order(splats).long()):
        mean, conic, opacity, color = rows[order].split((2, 3, 1, 4), -1)
        dx, dy = (mean[:, None] - pixels).unbind(-1)
        a, b, c = conic[:, :, None].unbind(1)
        sigma = (a * dx * dx + c * dy * dy) / 2 + b * dx * dy
        alpha = (opacity * torch.exp(-sigma)).clamp_max(MAX_ALPHA)
        drawn = (limits[order, 2] > limits[order, 0]) & (limits[order, 3] > limits[order, 1])
        alpha = torch.where(drawn[:, None] & (sigma >= 0) & (alpha >= MIN_ALPHA), alpha, 0)
        after = (1 - alpha).cumprod(0)
        before = torch.cat((torch.ones_like(after[:1]), after[:-1]))
        weights = torch.where(after > MIN_TRANSMITTANCE, alpha * before, 0)
        color = torch.cat((color, torch.ones_like(opacity)), -1)
        planes.append((color.T @ weights).unflatten(-1, size))
        reached.append(torch.zeros_like(drawn).scatter(0, order, (weights > MIN_ALPHA).any(1)))
    return torch.stack(planes), torch.stack(reached)
