#!/usr/bin/env bash
# Unpacks a Debian suite's lavapipe (Vulkan on the CPU), loader and validation layers under PREFIX,
# with all libraries including the C library. Needs no root. trixie-backports has Mesa 26, the first
# with cooperative matrices; trixie has Mesa 25.
# usage: tools/dev/lavapipe.sh PREFIX [SUITE]      then: PREFIX/run PROGRAM ARGS...
set -euo pipefail

prefix=$(realpath -m "${1:?usage: tools/dev/lavapipe.sh PREFIX [SUITE]}")
suite=${2:-trixie-backports}
mkdir -p "$prefix"
exec 9> "$prefix/lock" && flock 9 # checkouts share the cache

say() { echo "zipsplat: $*" >&2; }

unpack() {
# Other repositories (Docker's) may also end in /debian.
# shellcheck disable=SC2016 # $(REPO_URI) is apt's
mirror=$(apt-get indextargets --format '$(REPO_URI)' 'Created-By: Packages' 'Origin: Debian' |
  awk '/\/debian(\.list)?\/?$/ { mirror = $0 } END { print mirror }')
mirror=${mirror:-https://deb.debian.org/debian}
say "unpacking lavapipe from $suite of $mirror in $prefix (84 MB to download)"

apt=$prefix/apt root=$prefix/root
rm -rf "$apt" "$root"
mkdir -p "$apt"/{lists,archives}/partial "$root"/usr/{bin,lib,lib64,sbin}
for dir in bin lib lib64 sbin; do ln -s "usr/$dir" "$root/$dir"; done

# apt verifies downloads with Debian's keys. Ubuntu packages them, signed by Ubuntu's.
keyring=/usr/share/keyrings/debian-archive-keyring.gpg
if [[ ! -e $keyring ]]; then
  (cd "$apt" && apt-get -qq download debian-archive-keyring > /dev/null && dpkg-deb -x debian-archive-keyring_*.deb .) ||
    { say "that needs Debian's keys: sudo apt-get update && sudo apt-get install debian-archive-keyring"; exit 1; }
  keyring=$apt$keyring
fi
for s in trixie trixie-backports; do
  echo "deb [arch=amd64 signed-by=$keyring] $mirror $s main"
done > "$apt/sources.list"
: > "$apt/status" # no installed packages, so every dependency is fetched
cat > "$apt/apt.conf" << END
Dir::Etc::SourceList "$apt/sources.list";
Dir::Etc::SourceParts "/dev/null";
Dir::State::Lists "$apt/lists";
Dir::State::Status "$apt/status";
Dir::Cache "$apt";
Acquire::Languages "none";
APT::Default-Release "$suite";
APT::Install-Recommends "false";
APT::Sandbox::User "root";
#clear APT::Update;
END
apt-get -c "$apt/apt.conf" -qq update
apt-get -c "$apt/apt.conf" -qq --download-only install \
  libvulkan1 mesa-vulkan-drivers vulkan-validationlayers > /dev/null
for package in "$apt"/archives/*.deb; do dpkg-deb -x "$package" "$root"; done
rm -r "$apt"
}
[[ -x $prefix/run ]] || unpack

# A newer C library needs its own dynamic loader, which takes no scripts.
cat > "$prefix/run.part" << 'END'
#!/usr/bin/env bash
root=$(dirname "$(realpath "$0")")/root
program=$(command -v -- "$1") || { echo "zipsplat: found no program $1" >&2; exit 127; }
set -- "$program" "${@:2}"
while [[ $(head -c 2 "$1" | tr -d '\0') == '#!' ]]; do
  read -r _ interpreter option < <(sed -n '1s/^#! */#! /p' "$1")
  [[ $interpreter != */env ]] || { interpreter=$(command -v -- "$option") && option=; }
  set -- "$interpreter" ${option:+"$option"} "$@"
done
# Subgroups of 16 are 1.4 times as fast as the default of 8 if vectors are that wide.
if grep -qsw avx512f /proc/cpuinfo; then export LP_NATIVE_VECTOR_WIDTH=${LP_NATIVE_VECTOR_WIDTH:-512}; fi
export VK_DRIVER_FILES=$root/usr/share/vulkan/icd.d/lvp_icd.json
export VK_LAYER_PATH=$root/usr/share/vulkan/explicit_layer.d VK_LOADER_LAYERS_DISABLE='~implicit~'
libraries=$root/usr/lib/x86_64-linux-gnu
exec "$libraries/ld-linux-x86-64.so.2" --library-path "$libraries${LD_LIBRARY_PATH:+:$LD_LIBRARY_PATH}" "$@"
END
chmod +x "$prefix/run.part"
mv "$prefix/run.part" "$prefix/run" # last: marks PREFIX as complete
