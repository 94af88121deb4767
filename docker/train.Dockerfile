# Training on NVIDIA. The host has a driver for CUDA 13 and NVIDIA's container toolkit; CUDA comes with JAX.
#   docker build -f docker/train.Dockerfile -t ddgrasp-train .
#   docker run --gpus all -v "$PWD/runs:/data/runs" ddgrasp-train run --preset paper
FROM python:3.12-slim-bookworm AS wheel
ARG VERSION=
WORKDIR /source
COPY . .
RUN ${VERSION:+env SETUPTOOLS_SCM_PRETEND_VERSION_FOR_DDGRASP="$VERSION"} \
    pip wheel --no-cache-dir --no-deps --wheel-dir /wheels .

FROM python:3.12-slim-bookworm
SHELL ["/bin/bash", "-o", "pipefail", "-c"]
RUN --mount=type=bind,from=wheel,source=/wheels,target=/wheels \
    --mount=type=bind,source=requirements.lock,target=/requirements.lock \
    pip install --no-cache-dir --constraint /requirements.lock "$(echo /wheels/*.whl)[cuda,warp]"
ENV NVIDIA_VISIBLE_DEVICES=all NVIDIA_DRIVER_CAPABILITIES=compute,utility DDGRASP_CACHE=/data/runs/.cache
WORKDIR /data
ENTRYPOINT ["ddgrasp"]
CMD ["--help"]
