# The service, its weights and both ways to draw: NVIDIA's EGL (mounted by the container toolkit) and Mesa's llvmpipe.
# Nothing is fetched at start. `deploy/verify-image` builds and tries it without a container engine.
#
#   docker build -t unbend .
#   docker build -t unbend --secret id=pip,src=$HOME/.config/pip/pip.conf .   # with an index of your own

ARG BASE=debian:bookworm-slim

FROM ${BASE} AS build
RUN apt-get update \
 && apt-get install -y --no-install-recommends python3 python3-venv \
 && rm -rf /var/lib/apt/lists/*
RUN python3 -m venv /opt/unbend
WORKDIR /src
ARG EXTRAS="service redis export lensfun otel"
ENV PIP_NO_CACHE_DIR=1 PIP_DISABLE_PIP_VERSION_CHECK=1 PIP_REQUIRE_HASHES=1
# The dependencies make a layer of their own, because they change less often than the code. Each is known by its hash. Two have
# no wheel for aarch64: there they are built from sources that are known by theirs.
COPY requirements.lock requirements-build.lock ./
COPY deploy/image/requirements.py deploy/image/
RUN --mount=type=secret,id=pip,target=/etc/pip.conf --mount=type=secret,id=ca,target=/etc/ssl/build-ca.pem \
    python3 deploy/image/requirements.py ${EXTRAS} > requirements.txt \
 && /opt/unbend/bin/pip install --only-binary=:all: -r requirements-build.lock --target /opt/build \
 && if [ "$(dpkg --print-architecture)" != amd64 ]; then \
      apt-get update && apt-get install -y --no-install-recommends g++ python3-dev libegl-dev libgl-dev libx11-dev && rm -rf /var/lib/apt/lists/* \
   && python3 deploy/image/requirements.py --built ${EXTRAS} > built.txt \
   && PYTHONPATH=/opt/build /opt/unbend/bin/pip install --no-deps --no-build-isolation --no-binary=:all: -r built.txt; \
    fi \
 && /opt/unbend/bin/pip install --only-binary=:all: -r requirements.txt
COPY pyproject.toml README.md LICENSE ./
COPY client client
COPY service service
RUN PYTHONPATH=/opt/build PIP_REQUIRE_HASHES=0 /opt/unbend/bin/pip install --no-deps --no-build-isolation --no-index . \
 && /opt/unbend/bin/pip uninstall -y --quiet pip setuptools \
 && find /opt/unbend -type d -name tests -prune -exec rm -rf {} +

FROM ${BASE}
# libturbojpeg0 keeps JPEGs in planes.
# libgl1 and libegl1 are glvnd's switchboards; libgl1-mesa-dri holds llvmpipe; NVIDIA's libraries come from the host.
RUN apt-get update \
 && apt-get install -y --no-install-recommends python3 libegl1 libgl1 libgl1-mesa-dri libturbojpeg0 \
 && rm -rf /var/lib/apt/lists/* /var/cache/apt /var/log/apt /var/log/dpkg.log
COPY deploy/image/10_nvidia.json /usr/share/glvnd/egl_vendor.d/10_nvidia.json
COPY --from=build /opt/unbend /opt/unbend
COPY deploy/image/healthcheck.py /opt/unbend/healthcheck.py
# Bytecode and shaders are not cached: the root file system is meant to be read-only. Two arenas of malloc hold less memory
# than glibc's default, and than jemalloc: docs/deployment.md.
ENV PATH=/opt/unbend/bin:$PATH \
    HOME=/tmp \
    PYTHONDONTWRITEBYTECODE=1 \
    PYTHONUNBUFFERED=1 \
    MALLOC_ARENA_MAX=2 \
    MESA_SHADER_CACHE_DISABLE=true \
    NVIDIA_VISIBLE_DEVICES=all \
    NVIDIA_DRIVER_CAPABILITIES=graphics,compute,utility \
    UNBEND_HTTP_HOST=0.0.0.0 \
    UNBEND_GRPC_HOST=0.0.0.0 \
    UNBEND_OPS_HOST=0.0.0.0 \
    UNBEND_OPS_PORT=8081 \
    UNBEND_LOG_FORMAT=json
USER 65532:65532
WORKDIR /tmp
EXPOSE 8080 50051 8081
STOPSIGNAL SIGTERM
HEALTHCHECK --interval=10s --timeout=5s --start-period=60s --retries=3 CMD ["python3", "/opt/unbend/healthcheck.py"]
ENTRYPOINT ["unbend"]
CMD ["serve"]
