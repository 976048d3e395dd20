#!/usr/bin/env bash
# Installs what the project needs on Debian 12 or Ubuntu 22.04/24.04: Vulkan libraries, a virtual environment in .venv
# with the versions of requirements.lock, and the package itself. It can be run again at any time. Without root it says what
# is missing and goes on: whatever needs no rendered image works.
set -euo pipefail
cd "$(dirname "$0")/.."

TORCH_VERSION=2.13.0
TORCH_CPU_INDEX=https://download.pytorch.org/whl/cpu
MIN_MESA=24.3 # lavapipe has what SAPIEN asks for from here on
WITHOUT_PICTURES="only what needs no rendered image works: obs_mode='state' or 'tacff' with render_backend='none'."

LAVAPIPE=/usr/local/lib/mesa-lavapipe
LAVAPIPE_SHA256=3899f1800424c60a05df5d6913076a526ca8fdbabec43672cd397563d1ca3263
LAVAPIPE_URLS=(
  "http://deb.debian.org/debian/pool/main/m/mesa/mesa-vulkan-drivers_25.0.7-2~bpo12+1_amd64.deb"
  "https://snapshot.debian.org/file/690815f474701be97646657f06069dcd3d56f644"
)

say() { printf '\033[1m%s\033[0m\n' "$*"; }
has_gpu() { command -v nvidia-smi >/dev/null 2>&1 && nvidia-smi -L >/dev/null 2>&1; }
# asks for the library, since the package that holds it has another name from release to release; no pipe into `grep -q`,
# which ends early and so makes `ldconfig` fail, and with it, under pipefail, the question
has_library() { [[ $(ldconfig -p) == *"$1"* ]]; }

has_browser() { command -v chromium || command -v chromium-browser || command -v google-chrome; } >/dev/null

as_root() {
  if [ "$(id -u)" = 0 ]; then "$@"; elif sudo -n true 2>/dev/null; then sudo "$@"; else return 1; fi
}

new_enough_mesa() {
  local version
  [ ! -f "$LAVAPIPE/libvulkan_lvp.so" ] || return 0
  version=$(dpkg-query -W -f='${Version}' mesa-vulkan-drivers 2>/dev/null) || return 1
  dpkg --compare-versions "$version" ge "$MIN_MESA"
}

add_mesa_source() { # a release of Mesa that is new enough, where the system's own is not
  . /etc/os-release
  case "$ID-$VERSION_ID" in
  debian-12)
    # the suite's address is that of the machine's own sources
    local uri
    uri=$({ cat /etc/apt/sources.list /etc/apt/sources.list.d/* 2>/dev/null || true; } |
      awk '/^URIs:/ && /debian/ && !/security/ {print $2; exit} /^deb / && !/security/ {for (i = 2; i <= NF; i++) if ($i ~ /^https?:/) {print $i; exit}}')
    echo "deb ${uri:-http://deb.debian.org/debian} bookworm-backports main" |
      as_root tee /etc/apt/sources.list.d/manifeel-backports.list >/dev/null
    as_root apt-get update -q
    MESA_RELEASE=(-t bookworm-backports)
    ;;
  esac
}

install_debians_lavapipe() { # Ubuntu 22.04 has no Mesa that is new enough; Debian's is built for its LLVM 15 and glibc
  . /etc/os-release
  [ "$ID-$VERSION_ID" = ubuntu-22.04 ] && [ "$(dpkg --print-architecture)" = amd64 ] || return 1
  local unpacked url
  unpacked=$(mktemp -d)
  for url in "${LAVAPIPE_URLS[@]}"; do
    /usr/lib/apt/apt-helper download-file "$url" "$unpacked/mesa.deb" "SHA256:$LAVAPIPE_SHA256" && break
  done
  dpkg-deb -x "$unpacked/mesa.deb" "$unpacked" &&
    sed "s#\"libvulkan_lvp.so\"#\"$LAVAPIPE/libvulkan_lvp.so\"#" "$unpacked/usr/share/vulkan/icd.d/lvp_icd.json" >"$unpacked/lvp_icd.json" &&
    as_root install -D -m 644 "$unpacked/lvp_icd.json" /usr/local/share/vulkan/icd.d/lvp_icd.json &&
    as_root install -D -m 644 "$unpacked/usr/lib/x86_64-linux-gnu/libvulkan_lvp.so" "$LAVAPIPE/libvulkan_lvp.so"
  rm -r "$unpacked"
  new_enough_mesa
}

install_system_packages() {
  local missing=() MESA_RELEASE=() pair
  for pair in libvulkan.so.1:libvulkan1 libEGL.so.1:libegl1 libGL.so.1:libgl1 libglib-2.0.so.0:libglib2.0-0; do
    has_library "${pair%%:*}" || missing+=("${pair##*:}")
  done
  python3 -c 'import ensurepip, venv' 2>/dev/null || missing+=(python3-venv)
  # the leaderboard's page is tried in a browser; Ubuntu's package is a snap, which containers do not run
  has_browser || ! grep -q '^ID=debian' /etc/os-release || missing+=(chromium)
  local mesa=true
  has_gpu || new_enough_mesa || mesa=false
  [ ${#missing[@]} = 0 ] && $mesa && return
  if ! command -v apt-get >/dev/null || ! as_root true; then
    say "No root: please have these installed: ${missing[*]} $($mesa || echo "mesa-vulkan-drivers (>= $MIN_MESA)")"
    say "Until then $WITHOUT_PICTURES"
    return
  fi
  export DEBIAN_FRONTEND=noninteractive
  as_root apt-get update -q
  [ ${#missing[@]} = 0 ] || as_root apt-get install -y -q --no-install-recommends "${missing[@]}"
  if ! $mesa; then
    as_root apt-get install -y -q --no-install-recommends mesa-vulkan-drivers || true
    if ! new_enough_mesa && ! install_debians_lavapipe; then
      { add_mesa_source && as_root apt-get install -y -q --no-install-recommends "${MESA_RELEASE[@]}" mesa-vulkan-drivers; } || true
    fi
    new_enough_mesa || say "No mesa-vulkan-drivers >= $MIN_MESA could be installed: $WITHOUT_PICTURES"
  fi
}

# Every package but torch has the version and the hash of requirements.lock. torch is installed before: its builds for the
# CPU and for CUDA are different files, so that one lock with hashes cannot name both.
install_python_packages() {
  [ -x .venv/bin/python ] || python3 -m venv .venv
  # nothing is compiled ahead: a module is compiled when it is first imported, and most of them never are
  local pip=(.venv/bin/python -m pip --disable-pip-version-check install --quiet --no-compile)
  if ! .venv/bin/python -c 'import torch' 2>/dev/null; then
    say "Installing torch"
    if has_gpu; then
      "${pip[@]}" "torch==$TORCH_VERSION"
    else
      "${pip[@]}" "torch==$TORCH_VERSION+cpu" 2>/dev/null || "${pip[@]}" --index-url "$TORCH_CPU_INDEX" "torch==$TORCH_VERSION" ||
        { say "$TORCH_CPU_INDEX cannot be reached: PyPI's torch, larger, for GPUs, is taken instead" && "${pip[@]}" "torch==$TORCH_VERSION"; }
    fi
  fi
  say "Installing the packages of requirements.lock"
  "${pip[@]}" --no-deps --require-hashes -r requirements.lock
  "${pip[@]}" --no-deps -e .
  # without libGL the opencv that mani-skill brings does not import; the headless one does
  .venv/bin/python -c 'import cv2' 2>/dev/null ||
    "${pip[@]}" --force-reinstall --no-deps --require-hashes -r <(locked opencv-python-headless)
}

locked() { # the lines of requirements.lock that pin a package
  awk -v name="$1" '/^[^ ]/ {found = index($0, name "==") == 1} found' requirements.lock
}

install_system_packages
install_python_packages
say "Ready. Renderer: $(.venv/bin/python -c 'from manifeel_ms3.tasks.rendering import available_render_backend as b; print(b())' 2>/dev/null)"
