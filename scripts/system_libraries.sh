#!/bin/sh
# Make sure the shared libraries that open3d loads are there; install them with apt where that is
# allowed, otherwise say exactly what to install.
set -eu
python="$1"
packages="libegl1 libgl1 libx11-6 libusb-1.0-0"

if "$python" -c "import open3d" 2>/dev/null; then
  exit 0
fi
if ! command -v apt-get >/dev/null 2>&1; then
  echo "open3d cannot be imported; install the libraries EGL, GL, X11 and libusb 1.0" >&2
  exit 1
fi
as_root=""
if [ "$(id -u)" -ne 0 ]; then
  if command -v sudo >/dev/null 2>&1 && sudo -n true 2>/dev/null; then
    as_root="sudo -n"
  else
    echo "open3d cannot be imported; run: sudo apt-get install $packages" >&2
    exit 1
  fi
fi
$as_root apt-get update -q
# shellcheck disable=SC2086  # the list is meant to split
DEBIAN_FRONTEND=noninteractive $as_root apt-get install -y -q --no-install-recommends $packages
"$python" -c "import open3d"
