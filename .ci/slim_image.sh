#!/usr/bin/env bash
# Remove from an environment what the container image does not need: bash slim_image.sh ENVIRONMENT
# SUMO's windows, games and tests; a second copy of SUMO's data; tests of libraries; Arrow's servers and buckets.
set -euo pipefail
cd "$1"/lib/python3*/site-packages
( cd sumo/bin && rm -f netedit sumo-gui activitygen dfrouter marouter netgenerate emissionsMap emissionsDrivingCycle )
rm -rf sumo/tools/contributed sumo/tools/game sumo/data/po sumo/data/locale sumo/data/tests sumo/data/3D sumo_data/data
rm -rf sumo/lib64 sumo/include sumo/cmake  # for programs in C++
rm -rf pyarrow/include pyarrow/src pyarrow/*flight* pyarrow/*s3*
find numpy scipy pyarrow shapely -type d -name tests -prune -exec rm -rf {} +
# What every command imports is compiled in advance, since the user of the container cannot write here.
"$1"/bin/python -m compileall -q -j 1 egvs jinja2 numba numpy pyarrow pydantic rich typer traci
