// A photo's exposure: an affine map of colors.

// Whether a saturated photo hides the exposed value: brighter than its white, darker than its black.
bool is_hidden(float exposed, float target) {
    return target >= 1 && exposed > 1 || target <= 0 && exposed < 0;
}
