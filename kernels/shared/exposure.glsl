// A photo's exposure: an affine map of colors.

// Whether a saturated photo hides the exposed value, beyond its white or black.
bool is_hidden(float exposed, float target) {
    return target >= 1 && exposed > 1 || target <= 0 && exposed < 0;
}
