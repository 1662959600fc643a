#!/usr/bin/env bash
# Builds the C library and installs header, libraries, pkg-config and CMake files under PREFIX.
# PREFIX is relocatable.
# usage: tools/install.sh PREFIX
#   DESTDIR         prefix of PREFIX, for packages
#   ZIPSPLAT_LIBDIR library folder below PREFIX: lib (default), lib64, lib/x86_64-linux-gnu
#   ZIPSPLAT_LIBS   folder of built libraries; skips the build. For a PREFIX owned by root:
#                   cargo build --release -p zipsplat-c
#                   sudo ZIPSPLAT_LIBS=target/release tools/install.sh /usr/local
set -euo pipefail

die() { echo "zipsplat: $*" >&2; exit 1; }

root=$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd)
prefix=${1:?usage: tools/install.sh PREFIX}
[[ $prefix == /* ]] || prefix=$PWD/$prefix
prefix=${DESTDIR:-}$prefix
libs=${ZIPSPLAT_LIBS:-}
lib=${ZIPSPLAT_LIBDIR:-lib}
[[ $lib != /* && /$lib/ != */../* ]] || die "ZIPSPLAT_LIBDIR: found $lib, expected a folder below PREFIX such as lib64"
for folder in include "$lib" "$lib/pkgconfig" "$lib/cmake/zipsplat"; do
  { mkdir -p "$prefix/$folder" && [[ -w $prefix/$folder ]]; } ||
    die "cannot write to $prefix/$folder; where that takes root, build as yourself and install as root:" \
      "cargo build --release -p zipsplat-c && sudo ZIPSPLAT_LIBS=target/release tools/install.sh $1"
done
if [[ -z $libs ]]; then
  PATH=$PATH:${CARGO_HOME:-$HOME/.cargo}/bin
  echo "zipsplat: building the C library, which takes some minutes the first time" >&2
  # One set of features with the command, so neither build invalidates the other.
  cargo build --manifest-path "$root/Cargo.toml" --release -p zipsplat-c -p zipsplat-cli
  libs=${CARGO_TARGET_DIR:-$root/target}/release
fi
[[ -e $libs/libzipsplat_c.a ]] || die "there is no libzipsplat_c.a in $libs: cargo build --release -p zipsplat-c makes it"

header=$root/engine/bindings/c/include/zipsplat.h
number() { awk -v name="ZS_$1" '$1 == "#define" && $2 == name { print $3 }' "$header"; }
version=$(number VERSION_MAJOR).$(number VERSION_MINOR).$(number VERSION_PATCH) abi=$(number ABI_VERSION)
# System libraries of a statically linked Rust standard library.
case $(uname -s) in
  Darwin) shared=libzipsplat.$abi.dylib link=libzipsplat.dylib system='-framework CoreFoundation -liconv -lm' ;;
  *) shared=libzipsplat.so.$abi link=libzipsplat.so system='-lgcc_s -lpthread -ldl -lm' ;;
esac

install -m 644 "$header" "$prefix/include/zipsplat.h"
install -m 755 "$libs/${link/zipsplat/zipsplat_c}" "$prefix/$lib/$shared"
ln -sf "$shared" "$prefix/$lib/$link"
install -m 644 "$libs/libzipsplat_c.a" "$prefix/$lib/libzipsplat.a"
# From the library folder to PREFIX.
up=$(printf '%s\n' "$lib" | sed 's:/*$::; s:[^/][^/]*:..:g')

# pc NAME DESCRIPTION LIBS: writes a pkg-config file.
pc() {
  cat > "$prefix/$lib/pkgconfig/$1.pc" << END
prefix=\${pcfiledir}/../$up
exec_prefix=\${prefix}
libdir=\${exec_prefix}/$lib
includedir=\${prefix}/include

Name: zipsplat
Description: $2
Version: $version
Cflags: -I\${includedir}
Libs: $3
END
}
# shellcheck disable=SC2016 # ${libdir} is pkg-config's
pc zipsplat 'Photos to a scene of 3D Gaussians, on Vulkan' '-L${libdir} -lzipsplat'
# shellcheck disable=SC2016
pc zipsplat-static 'The same, linked statically' '${libdir}/libzipsplat.a '"$system"

cat > "$prefix/$lib/cmake/zipsplat/zipsplat-config.cmake" << END
# find_package(zipsplat) gives zipsplat::zipsplat, the shared library, and zipsplat::static.
get_filename_component(_zipsplat "\${CMAKE_CURRENT_LIST_DIR}/../../$up" ABSOLUTE)
if(NOT TARGET zipsplat::zipsplat)
  add_library(zipsplat::zipsplat SHARED IMPORTED)
  set_target_properties(zipsplat::zipsplat PROPERTIES
    IMPORTED_LOCATION "\${_zipsplat}/$lib/$shared" IMPORTED_SONAME "$shared"
    INTERFACE_INCLUDE_DIRECTORIES "\${_zipsplat}/include")
  add_library(zipsplat::static STATIC IMPORTED)
  set_target_properties(zipsplat::static PROPERTIES
    IMPORTED_LOCATION "\${_zipsplat}/$lib/libzipsplat.a"
    INTERFACE_LINK_LIBRARIES "$system"
    INTERFACE_INCLUDE_DIRECTORIES "\${_zipsplat}/include")
endif()
END
# Satisfies programs that request this version or an earlier one of the same ABI.
cat > "$prefix/$lib/cmake/zipsplat/zipsplat-config-version.cmake" << END
set(PACKAGE_VERSION "$version")
if(NOT PACKAGE_FIND_VERSION VERSION_GREATER PACKAGE_VERSION AND PACKAGE_FIND_VERSION_MAJOR EQUAL $(number VERSION_MAJOR))
  set(PACKAGE_VERSION_COMPATIBLE TRUE)
endif()
if(PACKAGE_FIND_VERSION VERSION_EQUAL PACKAGE_VERSION)
  set(PACKAGE_VERSION_EXACT TRUE)
endif()
END
echo "zipsplat: version $version, ABI $abi, is in $prefix" >&2
