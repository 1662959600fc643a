#!/usr/bin/env bash
# Runs all tests on lavapipe with (synchronization) validation; layer messages fail.
# usage: tools/test.sh [ARGS of cargo test]
set -euo pipefail
# setup.sh only unpacks lavapipe on Debian and Ubuntu.
[[ -e /etc/debian_version ]] && driver=lavapipe || driver=system
export ZIPSPLAT_DRIVER=${ZIPSPLAT_DRIVER:-$driver}
# Subgroups of 8: lavapipe's wider vectors have no cooperative matrices.
export LP_NATIVE_VECTOR_WIDTH=${LP_NATIVE_VECTOR_WIDTH:-256}
# shellcheck source-path=SCRIPTDIR
source "$(dirname "${BASH_SOURCE[0]}")/setup.sh"

# An unpacked lavapipe has its own.
[[ -n ${CARGO_TARGET_X86_64_UNKNOWN_LINUX_GNU_RUNNER:-} ]] || apt_install vulkan-validationlayers
# For programs that use the C library.
apt_install g++ pkg-config libvulkan-dev
python3 -c 'import numpy' 2> /dev/null || apt_install python3 python3-numpy
export ZIPSPLAT_VALIDATION=1 VK_LAYER_SETTINGS_PATH="$root/tests/${ZIPSPLAT_LAYER_SETTINGS:-vk_layer_settings}.txt"
[[ " $* " == *" -p "* ]] || set -- --workspace "$@"
stage tests cargo test --manifest-path "$root/Cargo.toml" "$@"
