"""Projected Gaussians: layout and constants shared by all renderers."""

NEAR = 0.01
BLUR = 0.3  # added to the diagonal of a projected covariance, square pixels
MIN_ALPHA = 1 / 255
MAX_ALPHA = 0.999
MIN_TRANSMITTANCE = 1e-4
# Values per splat: mean (pixels) 2, conic 3, opacity 1, color 3, depth 1.
SPLAT = 10


def depth_order(splats):
    """[P, N] i32: Gaussians from near to far, ties by index."""
    return splats[..., 9].detach().argsort(dim=-1, stable=True).int()
