#!/usr/bin/env bash
# Tests the viewer in a headless browser against `zipsplat render`. Tests nothing without Node 20
# and Chromium (Debian: `apt-get install --no-install-recommends chromium nodejs npm`).
# usage: tests/viewer/run.sh [--test-name-pattern=WORDS] [page.test.mjs]
#   CHROME    browser; default chromium, google-chrome or chrome of the PATH
#   ZIPSPLAT  command; default the checkout's, which is built
#   PICTURES  folder for screenshots; default none
set -euo pipefail
here=$(cd "$(dirname "${BASH_SOURCE[0]}")" && pwd)
skip() { echo "skipped: the viewer's tests $1" >&2; exit 0; }
CHROME=${CHROME:-$(command -v chromium || command -v google-chrome || command -v chrome)} ||
  skip "found no browser; install chromium, or set CHROME"
command -v npm > /dev/null || skip "found no npm"
npm ping --silent > /dev/null 2>&1 || skip "reach no registry for their packages"
export CHROME ZIPSPLAT=${ZIPSPLAT:-$here/../../tools/zipsplat}
cd "$here"
npm ci --silent --no-audit --no-fund
files=(*.test.mjs)
[[ ${*: -1} != *.mjs ]] || files=()
exec node --test --test-concurrency=1 --test-timeout=600000 "$@" "${files[@]}"
