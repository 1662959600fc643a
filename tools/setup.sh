#!/usr/bin/env bash
# Selects the Vulkan driver, installs missing packages and exports cargo's runner for that driver.
# Sourced by zipsplat, demo.sh, test.sh and .ci/run; on its own it runs a cargo command.
# usage: tools/setup.sh [cargo run --release -- doctor list]
#   ZIPSPLAT_DRIVER  auto: a GPU, else lavapipe (default) | system: the Vulkan loader's |
#                    lavapipe | lavapipe25 | wide-lavapipe | swiftshader
#   ZIPSPLAT_PROFILE cargo profile of the command; default release
#   ZIPSPLAT_CACHE   drivers, compiled shaders and libshaderc; default ~/.cache/zipsplat
set -euo pipefail

root=$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd)
cache=${ZIPSPLAT_CACHE:-${XDG_CACHE_HOME:-$HOME/.cache}/zipsplat}
mkdir -p "$cache"
cache=$(cd "$cache" && pwd)
export MESA_SHADER_CACHE_DIR="$cache/mesa" # lavapipe compiles for up to a second per kernel
PATH=$PATH:${CARGO_HOME:-$HOME/.cargo}/bin

say() { echo "zipsplat: $*" >&2; }
note() { [[ -n ${quiet:-} ]] || say "$@"; }
die() { say "$@"; exit 1; }

[[ $cache != *[[:space:]]* ]] ||
  die "the cache folder is '$cache', and cargo runs nothing from a path with spaces: set ZIPSPLAT_CACHE"

# zipsplat ARGS...: builds and runs the command on the selected driver.
zipsplat() { cargo "${run_zipsplat[@]}" "$@"; }
run_zipsplat=(run --manifest-path "$root/Cargo.toml" --profile "${ZIPSPLAT_PROFILE:-release}" --quiet -p zipsplat-cli --)

# build ARGS...: cargo build, with a line if it takes longer than a second or waits for another.
build() {
  { sleep 1 > /dev/null 2>&1 && say "building (or waiting for another build); the first time takes minutes"; } &
  local timer=$! status=0
  cargo build --manifest-path "$root/Cargo.toml" --quiet "$@" || status=$?
  kill $timer 2> /dev/null || true
  return $status
}

# stage NAME COMMAND...: runs COMMAND and prints its time.
stage() {
  local TIMEFORMAT="zipsplat: $1 took %1R s"
  time "${@:2}"
}

apt_install() {
  [[ -e /etc/debian_version ]] || return 0
  local package missing=() as_root=()
  for package in "$@"; do
    [[ $(dpkg-query -W -f '${db:Status-Status}' "$package" 2> /dev/null) == installed ]] || missing+=("$package")
  done
  [[ ${#missing[@]} != 0 ]] || return 0
  [[ $EUID == 0 ]] || as_root=(sudo -n)
  say "installing ${missing[*]}"
  # Ignores broken third-party sources.
  "${as_root[@]}" apt-get -qq update 2> /dev/null || true
  "${as_root[@]}" env DEBIAN_FRONTEND=noninteractive \
    apt-get -qq -y --no-install-recommends install "${missing[@]}" > /dev/null ||
    { say "that failed; please run: sudo apt-get update && sudo apt-get install ${missing[*]}"; return 1; }
}

wanted_rust() { sed -n 's/^rust-version = "\(.*\)"/\1/p' "$root/Cargo.toml"; }

check_rust() {
  local wanted found
  wanted=$(wanted_rust)
  found=$(cargo --version 2> /dev/null | awk '{ print $2 }') || true
  printf '%s\n' "$wanted" "${found:-0}" | sort -V -C ||
    die "needs Rust $wanted or newer and found ${found:-none}: install it from https://rustup.rs"
}

# offers_device PATTERN: whether the loader finds a Vulkan 1.3 device whose type matches.
offers_device() {
  vulkaninfo --summary 2> /dev/null | awk -v type="PHYSICAL_DEVICE_TYPE_($1)" '
    /apiVersion/ { match($0, /1\.[0-9]+/); minor = substr($0, RSTART + 2, RLENGTH - 2) + 0 }
    $0 ~ type && minor >= 3 { found = 1 }
    END { exit !found }'
}

find_gpu() {
  local gpu='DISCRETE_GPU|INTEGRATED_GPU'
  compgen -G '/dev/dri/renderD*' > /dev/null || compgen -G '/dev/nvidia[0-9]*' > /dev/null || return 1
  command -v vulkaninfo > /dev/null || apt_install libvulkan1 vulkan-tools ||
    die "this machine seems to have a GPU, and without vulkaninfo its driver cannot be looked for. Install it as above, or" \
      "set ZIPSPLAT_DRIVER=system to take what the Vulkan loader finds, or ZIPSPLAT_DRIVER=lavapipe to run on the CPU"
  offers_device "$gpu" && return
  if [[ -e /dev/dri ]] && apt_install mesa-vulkan-drivers && offers_device "$gpu"; then return; fi
  say "no Vulkan 1.3 driver answers for this machine's GPU (missing, too old, or no permission to use it)"
  return 1
}

# use_lavapipe VERSION SUITE: unpacks Debian's lavapipe, or falls back to the distribution's.
use_lavapipe() {
  local prefix=$cache/lavapipe$1 version
  if [[ $(uname -m) == x86_64 ]] && "$root/tools/dev/lavapipe.sh" "$prefix" "$2"; then
    export CARGO_TARGET_X86_64_UNKNOWN_LINUX_GNU_RUNNER=$prefix/run
    note "Vulkan on the CPU: $prefix"
    return
  fi
  apt_install libvulkan1 mesa-vulkan-drivers
  version=$(dpkg-query -W -f '${Version}' mesa-vulkan-drivers)
  dpkg --compare-versions "$version" ge 25 ||
    die "this system's lavapipe (Mesa $version) computes wrong results: needs Mesa 25 or a GPU with a Vulkan 1.3 driver"
  VK_DRIVER_FILES=$(compgen -G '/usr/share/vulkan/icd.d/lvp_icd*.json')
  export VK_DRIVER_FILES
  note "Vulkan on the CPU: Mesa $version"
}

# use_driver NAME: selects the driver of tools/dev/NAME.sh with lavapipe's loader and layers.
use_driver() {
  "$root/tools/dev/$1.sh" "$cache/$1" "$cache/lavapipe26" || die "no $1"
  export CARGO_TARGET_X86_64_UNKNOWN_LINUX_GNU_RUNNER=$cache/$1/run
  note "Vulkan on the CPU: $cache/$1"
}

[[ -e /etc/debian_version ]] || offers_device '.*' ||
  die "only Debian and Ubuntu are set up automatically; here, please install Rust $(wanted_rust) or newer," \
    "vulkaninfo (vulkan-tools), the Vulkan loader and a Vulkan 1.3 driver (the GPU's, or lavapipe of Mesa 25 on)," \
    "and for the tests the Khronos validation layer"
check_rust
if [[ -e /etc/debian_version ]]; then
  command -v cc > /dev/null || apt_install gcc libc6-dev
  case ${ZIPSPLAT_DRIVER:-auto} in
    auto) if find_gpu; then note "Vulkan on the GPU"; else use_lavapipe 26 trixie-backports; fi ;;
    system) apt_install libvulkan1 ;;
    lavapipe) use_lavapipe 26 trixie-backports ;;
    lavapipe25) use_lavapipe 25 trixie ;;
    wide-lavapipe | swiftshader) use_lavapipe 26 trixie-backports && use_driver "$ZIPSPLAT_DRIVER" ;;
    *)
      die "ZIPSPLAT_DRIVER is '$ZIPSPLAT_DRIVER': expected auto, system, lavapipe, lavapipe25, wide-lavapipe or swiftshader" ;;
  esac
else
  case ${ZIPSPLAT_DRIVER:-auto} in
    auto | system) ;; # the Vulkan loader's driver
    *)
      die "ZIPSPLAT_DRIVER is '$ZIPSPLAT_DRIVER': expected auto or system, as others are unpacked on Debian and Ubuntu only" ;;
  esac
fi

# Executed, not sourced.
if [[ ${BASH_SOURCE[0]} == "$0" && $# != 0 ]]; then exec "$@"; fi
