#!/usr/bin/env bash
# Unpacks SwiftShader (Vulkan on the CPU, unrelated to Mesa) under PREFIX from Debian's Chromium.
# Loader and layers are those of tools/dev/lavapipe.sh in LAVAPIPE.
# usage: tools/dev/swiftshader.sh PREFIX LAVAPIPE      then: PREFIX/run PROGRAM ARGS...
set -euo pipefail

prefix=$(realpath -m "${1:?usage: tools/dev/swiftshader.sh PREFIX LAVAPIPE}")
root=$(realpath -m "${2:?usage: tools/dev/swiftshader.sh PREFIX LAVAPIPE}")/root
mkdir -p "$prefix"
exec 9> "$prefix/lock" && flock 9 # checkouts share the cache
[[ ! -x $prefix/run ]] || exit 0
[[ -d $root ]] || { echo "zipsplat: $root has no unpacked lavapipe: SwiftShader runs on x86-64 only" >&2; exit 1; }

cd "$prefix"
rm -rf package ./*.deb
if ! apt-get -qq -o APT::Sandbox::User=root download chromium-common > /dev/null; then
  echo "zipsplat: SwiftShader comes from Debian's package chromium-common, which cannot be had here" >&2
  exit 1
fi
dpkg-deb -x chromium-common_*.deb package
mv package/usr/lib/chromium/{libvk_swiftshader.so,vk_swiftshader_icd.json} .
rm -r package ./*.deb

cat > run.part << END
#!/usr/bin/env bash
export VK_DRIVER_FILES=$prefix/vk_swiftshader_icd.json
export VK_LAYER_PATH=$root/usr/share/vulkan/explicit_layer.d VK_LOADER_LAYERS_DISABLE='~implicit~'
exec $root/usr/lib/x86_64-linux-gnu/ld-linux-x86-64.so.2 --library-path $root/usr/lib/x86_64-linux-gnu "\$@"
END
chmod +x run.part
mv run.part run # last: marks PREFIX as complete
