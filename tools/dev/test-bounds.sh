#!/usr/bin/env bash
# Runs kernels and stages with GPU-AV, which checks every access against its binding, without tests
# that would take minutes.
set -euo pipefail
test=$(dirname "${BASH_SOURCE[0]}")/../test.sh
export ZIPSPLAT_LAYER_SETTINGS=vk_layer_settings_bounds ZIPSPLAT_BOUND=1
slow=(determinism every_head_size every_epilogue short_and_long_sums beyond_the_most tiles_of_gpus bound_in_parts self_test
  tuning small_is_vits slice_of_the_giant)
said=$(mktemp)
trap 'rm "$said"' EXIT
# The layer aborts processes that exit with an open device, so output decides, not status.
{
  "$test" -p zipsplat-tests --test kernels -- --ignored reading_beyond_what_is_bound || true
  "$test" --no-fail-fast -p zipsplat-tests --test kernels --test stages -- "${slow[@]/#/--skip=}" || true
} 2>&1 | tee "$said"
[[ $(grep -c '^test result: ok' "$said") == 3 ]] || { echo "zipsplat: not all of these tests have passed" >&2; exit 1; }
