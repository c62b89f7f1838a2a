#!/usr/bin/env bash
# Set up a checkout: .venv, Trilane with the extras named in $1 (comma separated), and a working EGL.
# Exit code 3: this machine lacks something; the last line says what to type.
set -euo pipefail
cd "$(dirname "$0")/.."
extras=${1:-}

say() { printf 'setup: %s\n' "$*" >&2; }
lacks() { say "$1"; say "install it with: $2"; exit 3; }

# apt_or_lacks WHAT PACKAGE...: as root on Debian or Ubuntu install the packages, else print the line to type.
apt_or_lacks() {
  local what=$1
  shift
  if [ "$(id -u)" -eq 0 ] && command -v apt-get >/dev/null; then
    say "$what; installing $*"
    if apt-get update -qq >&2 && DEBIAN_FRONTEND=noninteractive apt-get install -y -qq --no-install-recommends "$@" >&2; then
      return
    fi
    lacks "$what, and apt-get could not install it" "apt-get update && apt-get install -y $*"
  fi
  lacks "$what" "sudo apt-get update && sudo apt-get install -y $*"
}

is_new_enough() { "$1" -c 'import sys; sys.exit(sys.version_info < (3, 11))' >/dev/null 2>&1; }

find_python() {
  local name
  for name in python3 python3.14 python3.13 python3.12 python3.11; do
    if is_new_enough "$name"; then
      printf '%s\n' "$name"
      return
    fi
  done
  lacks "Python 3.11 or newer is needed, found $(python3 --version 2>&1 || true)" \
    "sudo apt-get install -y python3.11 python3.11-venv"
}

make_venv() {
  local python version
  python=$(find_python)
  version=$("$python" -c 'import sys; print("%d.%d" % sys.version_info[:2])')
  if ! "$python" -c 'import ensurepip, venv' >/dev/null 2>&1; then
    apt_or_lacks "Python $version has no venv module" "python$version-venv"
  fi
  say "making .venv with Python $version"
  "$python" -m venv --clear .venv || lacks "Python $version could not make .venv" "sudo apt-get install -y python$version-venv"
}

# Exit code 0: a context can be made; 3: it cannot; else the packages themselves do not work.
try_egl() { .venv/bin/python -c 'import sys
from trilane.errors import MissingPartError
from trilane.stages.gpu.opengl import open_context
try:
    open_context()
except MissingPartError:
    sys.exit(3)'; }
has_egl() {
  local code=0
  try_egl || code=$?
  if [ "$code" -ne 0 ] && [ "$code" -ne 3 ]; then
    lacks "the installed packages do not work (see above)" "make clean, then make again"
  fi
  [ "$code" -eq 0 ]
}
# Only the tests of the dashboard's page need a browser; where it cannot be installed they are skipped, with the reason.
wants_browser() { [[ ",$extras," == *,all,* || ",$extras," == *,browser,* ]]; }
has_browser() { command -v chromium >/dev/null || command -v chromium-browser >/dev/null || command -v google-chrome >/dev/null; }
has_pip() { .venv/bin/python -m pip --version >/dev/null 2>&1; }

{ is_new_enough .venv/bin/python && has_pip; } || make_venv
# Earlier versions compiled the scheduler here; Python would import what they left in place of the sources.
rm -f src/*.so src/trilane/*/*.so
say "installing packages (${extras:-no extras}); the first time takes a minute or more and up to 1 GB, with all extras minutes and 3 GB"
.venv/bin/python -m pip install --quiet --disable-pip-version-check --editable ".${extras:+[$extras]}" ||
  lacks "pip could not install the packages (see above): no network, or no wheel for this Python and machine" \
    ".venv/bin/python -m pip install --editable '.${extras:+[$extras]}'"
.venv/bin/python -m compileall -q src/trilane >&2 || true # units start sooner; a read-only tree does without
if ! has_egl; then
  apt_or_lacks "no OpenGL 3.3 context can be made through EGL" libegl1 libgl1-mesa-dri
  has_egl || lacks "EGL and Mesa are installed, yet no OpenGL 3.3 context can be made; see: .venv/bin/trilane doctor" \
    "sudo apt-get install --reinstall -y libegl1 libgl1-mesa-dri"
fi
if wants_browser && ! has_browser; then
  (apt_or_lacks "no Chromium for the tests of the dashboard's page" chromium) || say "without it they are skipped"
fi
