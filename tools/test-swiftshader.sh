#!/usr/bin/env bash
# Kernels, stages and pictures on SwiftShader, whose compiler shares nothing with Mesa's: subgroups of 4, no 16-bit floats.
set -euo pipefail
ZIPSPLAT_DRIVER=swiftshader exec "$(dirname "${BASH_SOURCE[0]}")/test.sh" \
  -p zipsplat-tests --test kernels --test stages --test images "$@"
