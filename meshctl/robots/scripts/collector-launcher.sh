#!/bin/sh
# Runs the collector from the release this file stands in, with its own packages and nothing of the user's.
release=$(dirname "$(dirname "$(readlink -f "$0")")")
read -r python <"$release/python"
PYTHONPATH=$release/lib PYTHONNOUSERSITE=1 PYTHONSAFEPATH=1 PYTHONDONTWRITEBYTECODE=1
export PYTHONPATH PYTHONNOUSERSITE PYTHONSAFEPATH PYTHONDONTWRITEBYTECODE
exec "$python" -m meshctl.robots.collector "$release/etc/collector.json"
