# docker build --tag egvs .
# docker run --rm --user "$(id -u):$(id -g)" --volume "$PWD:/work" egvs run myplace
FROM python:3.11-slim-bookworm AS build

# SUMO is linked to OpenGL but opens no window. Only the three libraries are copied: their package brings 200 MB of drivers.
# binutils has the program strip, which .ci/slim_image.sh uses.
# hadolint ignore=DL3008
RUN apt-get update \
    && apt-get install --yes --no-install-recommends binutils libgl1 \
    && mkdir /opt/gl \
    && cp -L /usr/lib/*-linux-gnu/libGL.so.1 /usr/lib/*-linux-gnu/libGLX.so.0 /usr/lib/*-linux-gnu/libGLdispatch.so.0 /opt/gl/ \
    && rm -rf /var/lib/apt/lists/*

WORKDIR /source
COPY pyproject.toml constraints.txt README.md LICENSE ./
COPY data_schemas data_schemas
COPY scenarios scenarios
COPY pipeline pipeline
COPY .ci/slim_image.sh .ci/slim_image.sh
RUN python -m venv --without-pip /opt/egvs \
    && python -m pip --python /opt/egvs/bin/python install --no-cache-dir --no-compile --constraint constraints.txt . \
    && bash .ci/slim_image.sh /opt/egvs

FROM python:3.11-slim-bookworm

# hadolint ignore=DL3008
RUN apt-get update \
    && apt-get install --yes --no-install-recommends libatomic1 libexpat1 libx11-6 libxext6 libxrender1 \
    && rm -rf /var/lib/apt/lists/* \
    && useradd --uid 1000 --create-home egvs \
    && install --directory --owner egvs --mode 1777 /work /cache
COPY --from=build /opt/gl/ /usr/local/lib/
COPY --from=build /opt/egvs /opt/egvs
RUN ldconfig

# Results and compiled kernels of earlier runs: add --volume egvs-cache:/cache to keep them.
ENV PATH=/opt/egvs/bin:$PATH \
    HOME=/cache \
    XDG_CACHE_HOME=/cache
USER 1000:1000
WORKDIR /work
ENTRYPOINT ["egvs"]
CMD ["--help"]
