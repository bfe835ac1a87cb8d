#!/usr/bin/env bash
# Does the wheel work away from any checkout?   tools/check_wheel.sh [pinned|oldest|newest]
#
# Build the sdist, build the wheel from it, install it with the extra `ros` into an empty virtual environment, and there
# render a clip, track it, and replay it through the ROS graph. Both must give the same poses, and right ones.
#
#   pinned   dependencies as in requirements.txt (the default)
#   oldest   every lower bound of pyproject.toml, all at once (Python 3.11: later ones have no wheels of these)
#   newest   whatever pip resolves today, build backend included: a report that never fails
#
# PYTHON names the interpreter of the new environment (default: python3); the checkout's .venv builds (`make install`).
set -euo pipefail
root=$(cd "$(dirname "$0")/.." && pwd)
mode=${1:-pinned}
python=${PYTHON:-python3}
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
unset PYTHONPATH

# Mean pose error E_p of the clip and the share of its frames with a pose; measured 0.012 and 1.0.
most_error=0.05
least_coverage=0.9

pip_options=(--quiet --disable-pip-version-check)

step() {
  local name=$1 start=$SECONDS
  shift
  echo "$name" >"$work/step"
  "$@"
  printf '%-34s %4d s\n' "$name" $((SECONDS - start))
}

build_sdist() {
  # A clean copy, so that neither an old build/ nor ignored files get in.
  mkdir -p "$work/source" "$work/dist"
  git -C "$root" ls-files -z --cached --others --exclude-standard |
    tar -C "$root" --null --files-from=- --ignore-failed-read -c 2>/dev/null | tar -x -C "$work/source"
  (cd "$work/source" && "$root/.venv/bin/python" -c \
    "from setuptools import build_meta; build_meta.build_sdist('$work/dist')") >"$work/build.log" 2>&1 ||
    { cat "$work/build.log"; return 1; }
}

build_wheel() {
  local isolation=(--no-build-isolation)
  [ "$mode" = newest ] && isolation=()
  "$root/.venv/bin/python" -m pip wheel "${pip_options[@]}" "${isolation[@]}" --no-deps --wheel-dir "$work/dist" \
    "$work"/dist/*.tar.gz
}

constraints() {
  case $mode in
    pinned) grep -v '^#' "$root/requirements.txt" ;;
    oldest) "$python" -c "
import tomllib
for need in tomllib.load(open('$root/pyproject.toml', 'rb'))['project']['dependencies']:
    print(need.replace('>=', '=='))" ;;
    newest) ;;
    *) echo "usage: $0 [pinned|oldest|newest]" >&2; return 2 ;;
  esac
}

install_wheel() {
  constraints >"$work/constraints.txt"
  "$python" -m venv "$work/venv"
  "$work/venv/bin/python" -m pip install "${pip_options[@]}" --constraint "$work/constraints.txt" \
    "$(ls "$work"/dist/*.whl)[ros]"
  "$work/venv/bin/python" -m pip check --disable-pip-version-check
  "$work/venv/bin/python" - >"$work/versions" <<'PY'
from importlib.metadata import requires, version
import re
names = [re.match(r"[\w.-]+", need)[0] for need in requires("hat_ros") if "extra ==" not in need]
print(*(f"{name}=={version(name)}" for name in names))
PY
}

use() { (cd "$work/away" && "$work/venv/bin/$1" "${@:2}"); }

check_package() {
  local said
  said=$(use hat --version)
  [ "$said" = "hat $(use python -c 'from importlib.metadata import version; print(version("hat_ros"))')" ] ||
    { echo "hat --version said: $said"; return 1; }
  use python - "$root" <<'PY'
import sys
from importlib.resources import files
from hat_ros import load_config
from hat_ros.config import preset_names
package = files("hat_ros")
assert not str(package).startswith(sys.argv[1]), f"{package} is the checkout"
assert (package / "py.typed").is_file()
assert (package / "segmentation" / "segmenter.onnx").is_file()
assert set(preset_names()) >= {"default", "mega_hat", "pico_hat"}, preset_names()
for name in preset_names():
    load_config(name)
PY
}

check_poses() {
  cmp "$work/away/track/poses.tum" "$work/away/replay/poses.tum"
  use python - "$most_error" "$least_coverage" <<'PY'
import json, sys
most_error, least_coverage = map(float, sys.argv[1:])
for run in ("track", "replay"):
    found = json.load(open(f"{run}/metrics.json"))
    error, coverage = found["E_p_mean"], found["coverage"]
    print(f"{run}: mean E_p {error:.4f} (at most {most_error}), coverage {coverage:.2f} (at least {least_coverage})")
    if not (error <= most_error and coverage >= least_coverage):
        sys.exit(f"{run}: out of bounds")
PY
}

check() {
  mkdir -p "$work/away"
  step "sdist" build_sdist
  step "wheel from the sdist" build_wheel
  step "install into an empty environment" install_wheel
  step "version, presets, py.typed" check_package
  step "hat synth" use hat synth probe --out clip --frames 30 --size 320 240 --focal 500 --quiet
  step "hat track" use hat track clip --out track --quiet
  step "hat replay" use hat replay clip --out replay --quiet
  step "same poses, right poses" check_poses
}

echo "wheel check, $mode versions, $("$python" --version)"
# A shell of its own: errexit is off inside conditions.
status=0
(set -e; check) & wait $! || status=$?
[ -f "$work/versions" ] && fold -sw 118 "$work/versions"
if [ "$status" -eq 0 ]; then
  echo "wheel check, $mode versions: passed in $SECONDS s"
elif [ "$mode" = newest ]; then
  echo "REPORT: with the newest versions, '$(cat "$work/step")' fails; the tested versions are in requirements.txt"
else
  echo "wheel check, $mode versions: '$(cat "$work/step")' FAILED" >&2
  exit 1
fi
