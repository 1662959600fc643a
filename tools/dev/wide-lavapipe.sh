#!/usr/bin/env bash
# Makes a lavapipe with subgroups of 32 under PREFIX from the one in LAVAPIPE: patches its limit of
# 16 at any vector width.
# usage: tools/dev/wide-lavapipe.sh PREFIX LAVAPIPE      then: PREFIX/run PROGRAM ARGS...
set -euo pipefail

prefix=$(realpath -m "${1:?usage: tools/dev/wide-lavapipe.sh PREFIX LAVAPIPE}")
root=$(realpath -m "${2:?usage: tools/dev/wide-lavapipe.sh PREFIX LAVAPIPE}")/root
library=$root/usr/lib/x86_64-linux-gnu/libvulkan_lvp.so
mkdir -p "$prefix"
exec 9> "$prefix/lock" && flock 9 # checkouts share the cache
[[ ! -x $prefix/run || $library -nt $prefix/run ]] || exit 0
[[ -e $library ]] || { echo "zipsplat: $root has no unpacked lavapipe, which is there on x86-64 only" >&2; exit 1; }

# min(width / 32, 16), compiled: cmp width, 512; mov lanes, 16. Other counts of matches would
# include unrelated code.
perl -0777 -pe '
  s/(\x3d|\x81[\xf8-\xff])\0\x02\0\0([\xb8-\xbf])\x10\0\0\0/$1\0\x04\0\0$2\x20\0\0\0/g == 8
    or die "zipsplat: $ARGV does not compare widths with 512 in 8 places, as Mesa 25 and 26 do: it cannot be widened\n"
' "$library" > "$prefix/libvulkan_lvp.so"
sed "s,\"library_path\": \".*\",\"library_path\": \"$prefix/libvulkan_lvp.so\"," \
  "$root/usr/share/vulkan/icd.d/lvp_icd.json" > "$prefix/lvp_icd.json"

cat > "$prefix/run.part" << END
#!/usr/bin/env bash
export VK_DRIVER_FILES=$prefix/lvp_icd.json LP_NATIVE_VECTOR_WIDTH=1024 MESA_SHADER_CACHE_DIR=$prefix/shaders
export VK_LAYER_PATH=$root/usr/share/vulkan/explicit_layer.d VK_LOADER_LAYERS_DISABLE='~implicit~'
exec $root/usr/lib/x86_64-linux-gnu/ld-linux-x86-64.so.2 --library-path $root/usr/lib/x86_64-linux-gnu "\$@"
END
chmod +x "$prefix/run.part"
mv "$prefix/run.part" "$prefix/run" # last: marks PREFIX as complete
