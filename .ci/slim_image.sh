#!/usr/bin/env bash
# Remove from an environment what the container image does not need: bash slim_image.sh ENVIRONMENT
# SUMO's windows, games, tests and unused programs; a second copy of SUMO's data; tests of libraries; Arrow's servers and buckets.
set -euo pipefail
cd "$1"/lib/python3*/site-packages
( cd sumo/bin && rm -f netedit sumo-gui activitygen dfrouter emissionsDrivingCycle emissionsMap jtrrouter marouter netgenerate od2trips polyconvert )
rm -rf sumo/tools/{contributed,game,neteditTestFunctions,webWizard} sumo/data/{po,locale,tests,3D,logo,font} sumo_data/data
rm -rf sumo/lib64 sumo/include sumo/cmake  # for programs in C++
rm -rf pyarrow/include pyarrow/src pyarrow/*flight* pyarrow/*s3*
find numba numpy scipy pyarrow shapely -type d -name tests -prune -exec rm -rf {} +

# SUMO's programs load BLAS with GDAL, and call neither: two builds of one version, of 39 MB each, share a file.
if [ "$(find eclipse_sumo.libs -name 'libopenblas[op]-*' | wc -l)" = 2 ]; then
    ( cd eclipse_sumo.libs && ln -sf libopenblasp-*.so libopenblaso-*.so )
fi
# A wheel cannot hold links, so Arrow's holds the same library under three names.
for library in pyarrow/libarrow_python*.so.*.*; do
    for name in "${library%.so.*}.so" "${library%.*.*}"; do
        cmp -s "$library" "$name" && ln -sf "$(basename "$library")" "$name"
    done
done

# Names of functions for debuggers; the largest libraries only, whose wheels were not patched.
strip --strip-unneeded llvmlite/binding/libllvmlite.so
find pyarrow -name '*.so*' -type f -exec strip --strip-unneeded {} +

# What every command imports is compiled in advance, since the user of the container cannot write here.
"$1"/bin/python -m compileall -q -j 1 egvs jinja2 numba numpy pyarrow pydantic rich typer traci
