#!/usr/bin/env bash
# Every test, on lavapipe with Vulkan validation and synchronisation validation on: a message of the layer is a failure.
# usage: tools/test.sh [ARGS of cargo test]
set -euo pipefail
export ZIPSPLAT_DRIVER=${ZIPSPLAT_DRIVER:-lavapipe}
# shellcheck source-path=SCRIPTDIR
source "$(dirname "${BASH_SOURCE[0]}")/setup.sh"

export ZIPSPLAT_VALIDATION=1 VK_LAYER_SETTINGS_PATH="$root/tests/vk_layer_settings.txt"
stage tests cargo test --manifest-path "$root/Cargo.toml" --workspace "$@"
