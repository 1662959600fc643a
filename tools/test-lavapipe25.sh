#!/usr/bin/env bash
# tools/test.sh on Mesa 25, which many machines have: no cooperative matrices, and kernels compile ten times slower.
set -euo pipefail
ZIPSPLAT_DRIVER=lavapipe25 exec "$(dirname "${BASH_SOURCE[0]}")/test.sh" "$@"
