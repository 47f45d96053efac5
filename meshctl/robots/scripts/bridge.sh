#!/bin/bash
# Runs the ROS 1 bridge of the release this file stands in, in ROS's own Python, which sees of our packages udp_mesh alone.
release=$(dirname "$(dirname "$(readlink -f "$0")")")
read -r setup <"$release/ros"
# shellcheck disable=SC1090  # ROS's own, as on the command line of its users
. "$setup" || exit 1
export PYTHONPATH=$release/ros1${PYTHONPATH:+:$PYTHONPATH} PYTHONDONTWRITEBYTECODE=1
config=$release/etc/bridge.yaml
[ ! -f "$config" ] || set -- "_config:=$config" "$@"
exec python3 -m udp_mesh.bridges.ros1 "$@"
