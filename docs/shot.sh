#!/bin/bash
# A picture of a recording, without a display:
#
#     docs/shot.sh runs/<UTC>-<name>/run.rrd picture.png
#
# It needs a Vulkan driver that works in software (Debian: mesa-vulkan-drivers) and, in the Python
# environment named by VENV, rerun-sdk of the version the bench records with:
#
#     python3 -m venv venv && venv/bin/pip install 'rerun-sdk[datafusion]==0.36.3'
#
# SIZE (1600x1000), WAIT (8 s for the viewer to load and draw) and PORT (9911) can be set too.
set -eu
if [ $# -ne 2 ]; then
    echo "usage: VENV=venv $0 RUN.rrd PICTURE.png" >&2
    exit 2
fi
recording=$(realpath "$1") picture=$(realpath -m "$2") port=${PORT:-9911}
venv=${VENV:?set VENV to a Python environment with rerun-sdk 0.36.3}
# The environment's bin/rerun is a wrapper: ending it would leave the viewer alive.
viewer=$(echo "$venv"/lib/python3*/site-packages/rerun_sdk/rerun_cli/rerun)
export XDG_RUNTIME_DIR=${XDG_RUNTIME_DIR:-$(mktemp -d)}
RUST_LOG=error "$viewer" "$recording" --headless --port "$port" --window-size "${SIZE:-1600x1000}" &
viewer_pid=$!
trap 'kill $viewer_pid' EXIT
sleep "${WAIT:-8}"
"$venv/bin/python" - "$port" "$picture" <<'PYTHON'
import sys
from rerun.experimental import ViewerClient
port, picture = sys.argv[1:]
ViewerClient(f"rerun+http://127.0.0.1:{port}/proxy").save_screenshot(picture)
PYTHON
