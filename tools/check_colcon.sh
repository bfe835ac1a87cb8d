#!/usr/bin/env bash
# Does `colcon build` give a package that works? Walked with colcon from PyPI and Ubuntu 24.04's versions of what apt brings.
#
# ROS 2 itself is not needed: the wheels of the extra `ros` stand in for the system's rclpy, and the ament index is asked
# as launch would ask it. PYTHON names the interpreter (default: python3); 3.11 and 3.12 have wheels of all the versions.
set -euo pipefail
root=$(cd "$(dirname "$0")/.." && pwd)
python=${PYTHON:-python3}
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
unset PYTHONPATH

colcon=(colcon-core==0.21.3 colcon-ros==0.5.0 colcon-bash==0.5.0 colcon-package-selection==0.2.10 catkin_pkg==1.1.1)
apt=(setuptools==68.1.2 numpy==1.26.4 scipy==1.11.4 opencv-python-headless==4.6.0.66 PyYAML==6.0.1 rich==13.7.1
  matplotlib==3.6.3 pillow==10.2.0)
# Mean pose error E_p of the clip; measured 0.012.
most_error=0.05

step() {
  local name=$1 start=$SECONDS
  shift
  "$@"
  printf '%-34s %4d s\n' "$name" $((SECONDS - start))
}

install_tools() {
  "$python" -m venv "$work/venv"
  source "$work/venv/bin/activate"
  python -m pip install --quiet --disable-pip-version-check "${colcon[@]}" "${apt[@]}" -r "$root/requirements-ros.txt" \
    $(grep -E '^(ros-|empy|lark-parser|packaging)' "$root/requirements.txt")
}

build() {
  mkdir -p "$work/ws/src/hat_ros"
  git -C "$root" ls-files -z --cached --others --exclude-standard |
    tar -C "$root" --null --files-from=- --ignore-failed-read -c 2>/dev/null | tar -x -C "$work/ws/src/hat_ros"
  (cd "$work/ws" && colcon build --packages-select hat_ros --event-handlers console_direct+) >"$work/build.log" 2>&1 ||
    { tail -n 40 "$work/build.log" | cut -c 1-300; return 1; }
}

check_places() {
  # As launch's FindPackageShare does.
  local share lib file name
  share=$(python -c "from ament_index_python.packages import get_package_share_directory as share; print(share('hat_ros'))")
  lib=$share/../../lib/hat_ros
  [ "$(realpath "$share")" = "$(realpath "$work/ws/install/hat_ros/share/hat_ros")" ]
  for file in "$share"/{package.xml,launch/hat.launch.py,config/{default.yaml,fastdds.xml}}; do
    [ -f "$file" ] || { echo "missing: $file"; return 1; }
  done
  for name in segmentation hypotheses slam selector fusion overlay player recorder; do
    [ -x "$lib/${name}_node" ] || { echo "missing: lib/hat_ros/${name}_node"; return 1; }
  done
  case $(cd "$work" && python -c 'import hat_ros; print(hat_ros.__file__)') in
    "$work"/ws/install/*) ;;
    *) echo "hat_ros is not imported from the install space"; return 1 ;;
  esac
}

hat() { (cd "$work" && "$work/ws/install/hat_ros/lib/hat_ros/hat" "$@"); }

check_poses() {
  cmp "$work/track/poses.tum" "$work/replay/poses.tum"
  python - "$work/track/metrics.json" "$most_error" <<'PY'
import json, sys
error = json.load(open(sys.argv[1]))["E_p_mean"]
print(f"mean E_p {error:.4f} (at most {sys.argv[2]})")
sys.exit(not error <= float(sys.argv[2]))
PY
}

echo "colcon check, $("$python" --version), ${apt[*]}"
step "install colcon, apt's versions" install_tools
step "colcon build" build
set +u
source "$work/ws/install/setup.bash"
set -u
step "share, lib, ament index" check_places
step "hat synth" hat synth probe --out clip --frames 30 --size 320 240 --focal 500 --quiet
step "hat track" hat track clip --out track --quiet
step "hat replay" hat replay clip --out replay --quiet
step "same poses, right poses" check_poses
echo "colcon check: passed in $SECONDS s"
