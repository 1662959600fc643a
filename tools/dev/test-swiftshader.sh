#!/usr/bin/env bash
# Runs kernels, stages and pictures on SwiftShader: subgroups of 4, no 16-bit floats, not Mesa.
set -euo pipefail
ZIPSPLAT_DRIVER=swiftshader exec "$(dirname "${BASH_SOURCE[0]}")/../test.sh" \
  -p zipsplat-tests --test kernels --test stages --test images "$@"
