#!/usr/bin/env bash
# Installs what the project needs on Debian 12 or Ubuntu 22.04/24.04: Vulkan libraries, a virtual environment in .venv
# with the versions of requirements.lock, and the package itself. It can be run again at any time. Without root it says what
# is missing and goes on: whatever needs no rendered image works. `scripts/setup.sh --undo` takes back what it added outside
# of this folder, and says what it leaves. Tests source this file, which then only defines its functions.
set -euo pipefail

TORCH_VERSION=2.13.0
TORCH_CPU_INDEX=https://download.pytorch.org/whl/cpu
MIN_MESA=24.3 # the first version whose lavapipe has all that SAPIEN needs
WITHOUT_PICTURES="only what needs no rendered image works: obs_mode='state' or 'tacff' with render_backend='none'."

DEBIAN_MIRROR=http://deb.debian.org/debian/ # used if the machine's sources name no mirror
DEBIAN_KEYRING=/usr/share/keyrings/debian-archive-keyring.gpg
BACKPORTS=/etc/apt/sources.list.d/manifeel-backports.list
INSTALLED=/var/lib/manifeel_ms3/packages # names of the Debian or Ubuntu packages that this script has installed

OS_RELEASE=/etc/os-release
LAVAPIPE=/usr/local/lib/mesa-lavapipe
LAVAPIPE_ICD=/usr/local/share/vulkan/icd.d/lvp_icd.json # the file through which Vulkan finds it
LAVAPIPE_SHA256=3899f1800424c60a05df5d6913076a526ca8fdbabec43672cd397563d1ca3263
LAVAPIPE_URLS=(
  "http://deb.debian.org/debian/pool/main/m/mesa/mesa-vulkan-drivers_25.0.7-2~bpo12+1_amd64.deb"
  "https://snapshot.debian.org/file/690815f474701be97646657f06069dcd3d56f644"
)

say() { printf '\033[1m%s\033[0m\n' "$*"; }
has_gpu() { command -v nvidia-smi >/dev/null 2>&1 && nvidia-smi -L >/dev/null 2>&1; }
# Asks for the library, since the name of its package changes from release to release. The list is read as a whole:
# a pipe into `grep -q` ends early, so that under pipefail a library that is there would count as missing.
LIBRARIES=
has_library() {
  LIBRARIES=${LIBRARIES:-$(PATH=$PATH:/usr/sbin:/sbin ldconfig -p)}
  [[ $LIBRARIES == *"$1"* ]]
}

has_package() { dpkg-query -W "$1" >/dev/null 2>&1; }
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

# Address of the first of the machine's sources that holds a suite of Debian's; nothing where there is none. apt itself reads the
# sources, in all of their formats, and knows from the lists that it has fetched which of them are Debian's.
debians_mirror() {
  local created_by release component origin uri
  # shellcheck disable=SC2016 # it is apt that fills in what is in $()
  while IFS='|' read -r created_by release component origin uri; do
    if [ "$created_by|$release|$component" = "Packages|$1|main" ] && [[ $origin == Debian* ]]; then
      echo "$uri"
      return
    fi
  done <<<"$(apt-get indextargets --format '$(CREATED_BY)|$(RELEASE)|$(COMPONENT)|$(ORIGIN)|$(REPO_URI)')"
}

add_mesa_source() { # for a newer Mesa, where the system's own is too old
  # shellcheck source=/dev/null
  . "$OS_RELEASE"
  [ "$ID-$VERSION_ID" = debian-12 ] || return 0
  as_root rm -f "$BACKPORTS" # left by an earlier run
  if [ -z "$(debians_mirror bookworm-backports)" ]; then
    local uri
    uri=$(debians_mirror bookworm)
    # what it offers counts only if Debian has signed it, whoever serves it
    echo "deb [signed-by=$DEBIAN_KEYRING] ${uri:-$DEBIAN_MIRROR} bookworm-backports main" | as_root tee "$BACKPORTS" >/dev/null
    # update this source alone, because a failure of another one says nothing about it
    if ! as_root apt-get update -q -o APT::Update::Error-Mode=any -o Dir::Etc::sourcelist="$BACKPORTS" \
      -o Dir::Etc::sourceparts=- -o APT::Get::List-Cleanup=0; then
      say "Debian's backports cannot be fetched from ${uri:-$DEBIAN_MIRROR}"
      as_root rm -f "$BACKPORTS"
      return 1
    fi
  fi
  MESA_RELEASE=(-t bookworm-backports)
}

install_debians_lavapipe() { # Ubuntu 22.04 has no Mesa that is new enough; Debian's is built for its LLVM 15 and glibc
  # shellcheck source=/dev/null
  . "$OS_RELEASE"
  [ "$ID-$VERSION_ID" = ubuntu-22.04 ] && [ "$(dpkg --print-architecture)" = amd64 ] || return 1
  local unpacked url
  unpacked=$(mktemp -d)
  for url in "${LAVAPIPE_URLS[@]}"; do
    /usr/lib/apt/apt-helper download-file "$url" "$unpacked/mesa.deb" "SHA256:$LAVAPIPE_SHA256" && break
  done
  dpkg-deb -x "$unpacked/mesa.deb" "$unpacked" &&
    sed "s#\"libvulkan_lvp.so\"#\"$LAVAPIPE/libvulkan_lvp.so\"#" "$unpacked/usr/share/vulkan/icd.d/lvp_icd.json" >"$unpacked/lvp_icd.json" &&
    as_root install -D -m 644 "$unpacked/lvp_icd.json" "$LAVAPIPE_ICD" &&
    as_root install -D -m 644 "$unpacked/usr/lib/x86_64-linux-gnu/libvulkan_lvp.so" "$LAVAPIPE/libvulkan_lvp.so"
  rm -r "$unpacked"
  new_enough_mesa
}

remember() { # that this script has installed these packages
  as_root mkdir -p "$(dirname "$INSTALLED")"
  printf '%s\n' "$@" | as_root tee -a "$INSTALLED" >/dev/null
}

install_system_packages() {
  local missing=() MESA_RELEASE=() pair
  for pair in libvulkan.so.1:libvulkan1 libEGL.so.1:libegl1 libGL.so.1:libgl1 libglib-2.0.so.0:libglib2.0-0; do
    has_library "${pair%%:*}" || missing+=("${pair##*:}")
  done
  python3 -c 'import ensurepip, venv' 2>/dev/null || missing+=(python3-venv)
  # tests open the leaderboard's page in a browser; Ubuntu's package is a snap, which containers do not run
  has_browser || ! grep -q '^ID=debian' "$OS_RELEASE" || missing+=(chromium)
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
  if [ ${#missing[@]} != 0 ]; then
    as_root apt-get install -y -q --no-install-recommends "${missing[@]}"
    remember "${missing[@]}"
  fi
  if ! $mesa; then
    local had_mesa=false
    ! has_package mesa-vulkan-drivers || had_mesa=true
    as_root apt-get install -y -q --no-install-recommends mesa-vulkan-drivers || true
    if ! new_enough_mesa && ! install_debians_lavapipe; then
      { add_mesa_source && as_root apt-get install -y -q --no-install-recommends "${MESA_RELEASE[@]}" mesa-vulkan-drivers; } || true
    fi
    $had_mesa || ! has_package mesa-vulkan-drivers || remember mesa-vulkan-drivers
    new_enough_mesa || say "No mesa-vulkan-drivers >= $MIN_MESA could be installed: $WITHOUT_PICTURES"
  fi
}

PYTHON=
find_python() { # the first Python for which requirements.lock names packages
  for PYTHON in python3 python3.12 python3.11 python3.10; do
    "$PYTHON" -c 'import sys; sys.exit(not (3, 10) <= sys.version_info[:2] <= (3, 12))' 2>/dev/null && return
  done
  say "Python 3.10, 3.11 or 3.12 is needed, and python3 is $(python3 --version 2>&1 || true); install one of these (as python3.12, for example) and run this script again."
  return 1
}

# Every package but torch, those that torch needs included, has the version and the hash of requirements.lock. torch's builds for
# the CPU and for CUDA are different files, so that one lock with hashes cannot name both; the latter itself names the exact
# versions of NVIDIA's packages that it needs.
install_python_packages() {
  if [ ! -x .venv/bin/python ]; then # no `||`, in which a failure would not end the script
    find_python
    "$PYTHON" -m venv .venv
  fi
  # nothing is compiled in advance: a module is compiled at its first import, and most modules are never imported
  local pip=(.venv/bin/python -m pip --disable-pip-version-check install --quiet --no-compile)
  say "Installing the packages of requirements.lock"
  "${pip[@]}" --no-deps --require-hashes -r requirements.lock
  if [ "$(.venv/bin/python -c 'import torch; print(torch.__version__.partition("+")[0])' 2>/dev/null)" != "$TORCH_VERSION" ]; then
    say "Installing torch"
    if has_gpu; then
      "${pip[@]}" "torch==$TORCH_VERSION"
    else
      "${pip[@]}" "torch==$TORCH_VERSION+cpu" 2>/dev/null || "${pip[@]}" --index-url "$TORCH_CPU_INDEX" "torch==$TORCH_VERSION" ||
        { say "$TORCH_CPU_INDEX cannot be reached; installing the larger torch for GPUs from PyPI instead" && "${pip[@]}" "torch==$TORCH_VERSION"; }
    fi
  fi
  "${pip[@]}" --no-deps --no-build-isolation -e .
  # without libGL the opencv that mani-skill brings does not import; the headless one does
  .venv/bin/python -c 'import cv2' 2>/dev/null ||
    "${pip[@]}" --force-reinstall --no-deps --require-hashes -r <(locked opencv-python-headless)
}

locked() { # the lines of requirements.lock that pin a package
  awk -v name="$1" '/^[^ ]/ {found = index($0, name "==") == 1} found' requirements.lock
}

undo() {
  local removed=()
  if [ -e "$BACKPORTS" ]; then
    as_root rm -f "$BACKPORTS" || { say "No root: $BACKPORTS cannot be removed" && return 1; }
    as_root apt-get update -q || true
    removed+=("$BACKPORTS")
  fi
  if [ -e "$LAVAPIPE" ]; then
    as_root rm -rf "$LAVAPIPE" "$LAVAPIPE_ICD" || { say "No root: $LAVAPIPE cannot be removed" && return 1; }
    removed+=("$LAVAPIPE" "$LAVAPIPE_ICD")
  fi
  if [ -e "$INSTALLED" ]; then
    local packages
    mapfile -t packages < <(sort -u "$INSTALLED")
    # what other packages need by now stays: only apt knows, and it removes no package that is marked as wanted
    { as_root apt-mark auto "${packages[@]}" && as_root rm "$INSTALLED"; } || { say "${packages[*]} cannot be given up" && return 1; }
    say "Given up: ${packages[*]}. \`apt-get autoremove\` removes those that no other package needs."
  fi
  say "Removed: ${removed[*]:-nothing; no source of packages and no copy of lavapipe had been added}"
  say "Left: .venv in this folder, and ~/.cache/manifeel_ms3."
}

main() {
  cd "$(dirname "${BASH_SOURCE[0]}")/.."
  case "$*" in
  "") ;;
  --undo)
    undo
    return
    ;;
  *)
    say "usage: scripts/setup.sh [--undo]" >&2
    return 2
    ;;
  esac
  install_system_packages
  install_python_packages
  say "Ready. Activate the environment with: source .venv/bin/activate. Renderer: $(.venv/bin/python -c 'from manifeel_ms3.rendering.backend import available_render_backend as b; print(b())')"
}

if [ "${BASH_SOURCE[0]}" = "$0" ]; then main "$@"; fi
