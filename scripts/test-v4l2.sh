#!/usr/bin/env bash
# Runs the V4L2 capture against real drivers without a camera: boots Debian's kernel in an emulated machine (qemu, no
# hardware virtualisation needed), loads the kernel's camera test driver (vivid) four times, plugs four USB cameras into its
# virtual USB controller, and does to the rig what happens to rigs. Prints a table; fails when a bound is broken. Takes about four minutes on two cores.
# Usage: scripts/test-v4l2.sh [PROGRAM]   (PROGRAM: the built v4l2-faults; built when left out)
# Environment: CYCLES (unplugged and replugged so often, 25), WORK (folder for kernel and image), FLYRIG (a built flyrig: its
# doctor and run are tried inside too, which needs 4 GB and some minutes more)
set -euo pipefail
cd "$(dirname "$0")/.."

say() { printf 'test-v4l2: %s\n' "$*"; }
work=${WORK:-${CARGO_TARGET_DIR:-target}/v4l2-vm}
mkdir -p "$work"
work=$(cd "$work" && pwd)

# package: why
wanted=(
  "qemu-system-x86:runs the emulated machine"
  "busybox-static:its shell"
  "cpio:packs its disk"
  "kmod:finds which kernel modules the test driver needs"
  "xz-utils:unpacks the kernel"
  "v4l-utils:v4l2-ctl, which injects the faults"
)
if ! command -v dpkg-query >/dev/null || [ "$(uname -m)" != x86_64 ]; then
  say "needs Debian or Ubuntu on x86-64; skipped"; exit 0
fi
missing=()
for entry in "${wanted[@]}"; do
  package=${entry%%:*}
  if ! dpkg-query -W -f='${Status}' "$package" 2>/dev/null | grep -q 'ok installed'; then
    missing+=("$package"); say "missing $package (${entry#*:})"
  fi
done
if [ ${#missing[@]} -gt 0 ]; then
  as_root=()
  [ "$(id -u)" -eq 0 ] || as_root=(sudo)
  say "installing with apt-get: ${missing[*]}"
  "${as_root[@]}" apt-get update -qq
  "${as_root[@]}" env DEBIAN_FRONTEND=noninteractive apt-get install -y -qq --no-install-recommends "${missing[@]}" >/dev/null
fi

program=${1:-}
if [ -z "$program" ]; then
  cargo build --release --locked -p flyrig-tests --bin v4l2-faults
  program=${CARGO_TARGET_DIR:-target}/release/v4l2-faults
fi

# The kernel is unpacked into $work and not installed. Cloud kernels lack the media drivers.
package=$(apt-cache depends linux-image-amd64 | awk '/Depends:/ { print $2; exit }')
version=${package#linux-image-}
if [ ! -e "$work/ready-$version" ]; then
  say "downloading $package (about 70 MB) into $work, where it is unpacked and not installed"
  (
    cd "$work"
    rm -rf ./*.deb boot lib
    apt-get download -qq -o APT::Sandbox::User=root "$package"
    drivers="./lib/modules/*/kernel/drivers"
    dpkg --fsys-tarfile linux-image*.deb | tar x --wildcards "./boot/vmlinuz-*" "$drivers/media/*" "$drivers/usb/*" './lib/modules/*/modules.*'
    rm -f ./*.deb
    # The compressed kernel begins at the magic number of xz.
    start=$(grep -abom1 $'\xFD7zXZ' "boot/vmlinuz-$version" | head -1 | cut -d: -f1)
    tail -c "+$((start + 1))" "boot/vmlinuz-$version" | xz -dc --single-stream >vmlinux.part 2>/dev/null || true
    depmod -b . "$version"
    mv vmlinux.part "vmlinux-$version"
    touch "ready-$version"
  )
fi

root=$work/root
rm -rf "$root"
mkdir -p "$root"/{bin,lib,mod,proc,sys,dev,tmp,usr/bin}
# Libraries are asked for under both names.
ln -s ../lib "$root/usr/lib"
cp /bin/busybox "$root/bin/"
for driver in vivid vhci-hcd uvcvideo; do modprobe -d "$work" -S "$version" --show-depends "$driver"; done | awk '/^insmod/ && !seen[$2]++ { print $2 }' |
  while read -r module; do
    cp "$module" "$root/mod/"
    basename "$module"
  done >"$root/mod/order"
copy_program() {
  cp -L "$1" "$root/usr/bin/${2:-}"
  { ldd "$1" 2>/dev/null || true; } | { grep -oE '/[^ ]+\.so[^ ]*' || true; } | while read -r library; do
    mkdir -p "$root$(dirname "$library")"
    cp -Lu "$library" "$root$library"
  done
}
copy_program /usr/bin/v4l2-ctl
copy_program "$program" v4l2-faults
memory=768
if [ -n "${FLYRIG:-}" ]; then
  say "simulating a calibration and a person for flyrig run"
  memory=4096
  # The adapter in software is found at run time.
  for library in libvulkan.so.1 libvulkan_lvp.so; do
    path=$(ldconfig -p | awk -v name="$library" '$1 == name && !found { print $NF; found = 1 }')
    path=${path:-/usr/lib/x86_64-linux-gnu/$library}
    copy_program "$path"
    mkdir -p "$root$(dirname "$path")"
    mv "$root/usr/bin/$library" "$root$path"
  done
  mkdir -p "$root/usr/share/vulkan/icd.d"
  cp /usr/share/vulkan/icd.d/lvp_icd*.json "$root/usr/share/vulkan/icd.d/"
  rm -rf "$work/rig"
  printf 'width = 320\nheight = 180\ntexture_px = 64\ncameras.count = 2\nmotion.kind = "still"\n' >"$work/sim.toml"
  "$FLYRIG" sim export "$work/sim.toml" --out "$work/rig" --frames 2 --no-truth
  cp -r "$work/rig" "$root/rig"
  copy_program "$FLYRIG" flyrig
  cat >"$root/rig.toml" <<RIG
[source]
kind = "cameras"
path = "/rig"
[[source.cameras]]
name = "00"
bus = "platform:vivid-000"
size = [320, 180]
fps = 10
[[source.cameras]]
name = "01"
nokhwa = "1"
size = [320, 180]
fps = 10
[perception]
pose = "given"
masks = "estimated"
[body]
template = "/rig/subject.glb"
gaussians = 2000
nodes = 50
RIG
fi

cat >"$root/init" <<INIT
#!/bin/busybox sh
/bin/busybox --install -s /bin
export PATH=/bin:/usr/bin
mount -t proc proc /proc; mount -t sysfs sys /sys; mount -t devtmpfs dev /dev; mount -t tmpfs tmp /tmp
mkdir -p /small; mount -t tmpfs -o size=8m small /small
for module in \$(cat /mod/order); do
  options=
  # Plain video capture only; the last device has the multi-planar interface.
  [ \$module = vivid.ko ] && options="n_devs=4 node_types=1,1,1,1 num_inputs=1,1,1,1 input_types=0,0,0,0 multiplanar=1,1,1,2"
  # Virtual USB devices do not wake up again.
  [ \$module = usbcore.ko ] && options="autosuspend=-1"
  insmod /mod/\$module \$options
done
# The stamps of ends of frames run a frame ahead in this driver.
for node in /dev/video*; do chmod 660 \$node; v4l2-ctl -d \$node -c timestamp_source=1; done
CYCLES=${CYCLES:-25} v4l2-faults
result=\$?
if [ -e /rig.toml ]; then
  ifconfig lo up
  mkdir -p /dev/shm; mount -t tmpfs shm /dev/shm
  flyrig doctor /rig.toml
  timeout -s INT ${RUN_SECONDS:-240} flyrig run /rig.toml --record /tmp/take.mcap || result=1
  flyrig replay /tmp/take.mcap || result=1
fi
echo "@@RC \$result"
poweroff -f
INIT
chmod +x "$root/init"
(cd "$root" && find . | cpio -o -H newc --quiet) >"$work/initrd.cpio"

say "booting $version with four test cameras"
timeout "${LIMIT:-900}" qemu-system-x86_64 -accel tcg,thread=multi -cpu max -smp 2 -m $memory -nic none -nographic -no-reboot \
  -kernel "$work/vmlinux-$version" -initrd "$work/initrd.cpio" -append "console=ttyS0 quiet panic=-1" </dev/null 2>&1 |
  stdbuf -oL tr -d '\r' | tee "$work/log" | { grep -a --line-buffered -v -e '^$' -e '^@@' || true; }
grep -aq '^@@RC 0' "$work/log" || { say "a bound was broken, or the machine did not finish; all it said is in $work/log"; exit 1; }
say "every bound was kept ($SECONDS s)"
