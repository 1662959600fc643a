#!/usr/bin/env bash
# Runs tools/test.sh on Mesa 25: no cooperative matrices, slower kernel compilation.
set -euo pipefail
ZIPSPLAT_DRIVER=lavapipe25 exec "$(dirname "${BASH_SOURCE[0]}")/../test.sh" "$@"
