#!/usr/bin/env bash
# Creates .venv with everything that `make demo` and `make test` need, and says what it does.
#   PYTHON       the Python to use, 3.10 to 3.13; default: the first of these that is installed
#   TORCH_INDEX  an index with CPU builds of torch, where your usual one has the larger builds with CUDA
set -euo pipefail
cd "$(dirname "$0")/.."

say() { printf '==> %s\n' "$*"; }
fail() { printf 'error: %s\n' "$*" >&2; exit 1; }

supported() { "$1" -c 'import sys; sys.exit(not (3, 10) <= sys.version_info[:2] <= (3, 13))' 2>/dev/null; }

choose_python() {
  if [ -n "${PYTHON:-}" ]; then
    supported "$PYTHON" || fail "PYTHON=$PYTHON is not a Python 3.10 to 3.13: choose one that is."
    return
  fi
  for PYTHON in python3 python3.12 python3.11 python3.13 python3.10; do
    supported "$PYTHON" && return
  done
  fail "no Python 3.10 to 3.13 found: install python3.11 (Debian 12) or python3.12 (Ubuntu 24.04), or set PYTHON."
}

# Debian packages that wheels expect of the system: Open3D (libusb, libGL, libgomp), and venv where Python lacks it.
missing_packages() {
  local libraries
  libraries=$(PATH="$PATH:/sbin:/usr/sbin" ldconfig -p 2>/dev/null || true)
  grep -q 'libusb-1\.0\.so\.0' <<<"$libraries" || echo libusb-1.0-0
  grep -q 'libGL\.so\.1' <<<"$libraries" || echo libgl1
  grep -q 'libgomp\.so\.1' <<<"$libraries" || echo libgomp1
  "$PYTHON" -c 'import ensurepip, venv' 2>/dev/null || basename "$(readlink -f "$(command -v "$PYTHON")")-venv"
}

install_packages() {
  local missing as_root=()
  missing=$(missing_packages | paste -sd' ')
  [ -n "$missing" ] || return 0
  if [ "$(id -u)" -ne 0 ]; then as_root=(sudo -n); fi
  if ! command -v apt-get >/dev/null; then
    fail "these system libraries are missing (Debian's names): $missing. Install them, then run make again."
  elif [ ${#as_root[@]} -gt 0 ] && ! sudo -n true 2>/dev/null; then
    fail "run this once, then make again:  sudo apt-get install -y $missing"
  fi
  say "installing system libraries: $missing"
  # shellcheck disable=SC2086
  { "${as_root[@]}" apt-get update -qq && "${as_root[@]}" env DEBIAN_FRONTEND=noninteractive apt-get install -y -qq $missing; } \
    >/dev/null || fail "apt-get could not install them; run:  sudo apt-get install -y $missing"
}

create_environment() {
  if [ -x .venv/bin/python ] && .venv/bin/python -m pip --version >/dev/null 2>&1; then
    say "using the virtual environment .venv"
    return
  fi
  say "creating the virtual environment .venv with $("$PYTHON" --version)"
  rm -rf .venv
  if [ -n "${ROS_DISTRO:-}" ]; then
    "$PYTHON" -m venv --system-site-packages .venv
  else
    "$PYTHON" -m venv .venv
  fi
}

pip_install() { .venv/bin/python -m pip install -qq --disable-pip-version-check "$@"; }

# Nothing here needs a GPU: a CPU build of torch is enough.
install_torch() {
  .venv/bin/python -c 'import torch' 2>/dev/null && return
  say "installing torch${TORCH_INDEX:+ from $TORCH_INDEX}"
  pip_install ${TORCH_INDEX:+--extra-index-url "$TORCH_INDEX"} 'torch==2.13.0'
}

install_project() {
  if [ -n "${ROS_DISTRO:-}" ]; then
    say "installing GAPR and its libraries; ROS is the sourced $ROS_DISTRO"
    pip_install --editable '.[training,bags,baselines,test]'
  else
    say "installing GAPR and its libraries; ROS 2 (rclpy, Fast DDS) from wheels, as no ROS is sourced (some minutes)"
    pip_install --editable '.[ros,training,baselines,test]'
  fi
}

check() {
  .venv/bin/python -c 'import open3d' 2>/dev/null || fail "Open3D does not load: $(.venv/bin/python -c 'import open3d' 2>&1 | tail -1)"
  .venv/bin/python -c 'import rclpy, sensor_msgs.msg' || fail "rclpy does not load; with a sourced ROS use its own Python: rm -rf .venv, then PYTHON=/usr/bin/python3 make ..."
}

# Numba keeps what it compiled on disk: better now than in the first run.
compile_kernels() {
  say "compiling"
  .venv/bin/gapr compile || fail "the first registration failed; see above"
}

choose_python
install_packages
create_environment
install_torch
install_project
check
compile_kernels
say "ready"
