"""What a Gaussian is once it is projected, and the constants of its blending, for every implementation of it."""

NEAR = 0.01
BLUR = 0.3  # added to the diagonal of a projected covariance, square pixels
MIN_ALPHA = 1 / 255
MAX_ALPHA = 0.999
MIN_TRANSMITTANCE = 1e-4
# What a splat holds: mean (pixels), conic, opacity, colour, depth.
SPLAT = 10


def depth_order(splats):
    """[P, N] i32: Gaussians from near to far, ties by index."""
    return splats[..., 9].detach().argsort(dim=-1, stable=True).int()
