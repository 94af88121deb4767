# A robot's computer: an ONNX file, a Franka arm, a RealSense; no JAX, no simulator. The host has a realtime kernel.
#   docker build -f docker/robot.Dockerfile -t ddgrasp-robot .
#   docker run -it --network host --cap-add SYS_NICE --ulimit rtprio=99 --ulimit memlock=-1 --device /dev/bus/usb \
#     -v "$PWD/runs:/data/runs" ddgrasp-robot deploy --robot franka --camera realsense --host 172.16.0.2 \
#     --policy pretrained/student/policy.onnx --dry-run
# Only runs/ is kept: calibrate board --out runs/board.pdf
FROM python:3.12-slim-bookworm AS wheel
ARG VERSION=
WORKDIR /source
COPY . .
RUN ${VERSION:+env SETUPTOOLS_SCM_PRETEND_VERSION_FOR_DDGRASP="$VERSION"} \
    pip wheel --no-cache-dir --no-deps --wheel-dir /wheels .

# franky has builds for x86-64 alone
# hadolint ignore=DL3029
FROM --platform=linux/amd64 python:3.12-slim-bookworm
SHELL ["/bin/bash", "-o", "pipefail", "-c"]
# hadolint ignore=DL3008
RUN apt-get update && apt-get install --yes --no-install-recommends libusb-1.0-0 && rm -rf /var/lib/apt/lists/*
RUN --mount=type=bind,from=wheel,source=/wheels,target=/wheels \
    --mount=type=bind,source=requirements.lock,target=/requirements.lock \
    pip install --no-cache-dir --constraint /requirements.lock "$(echo /wheels/*.whl)[franka,realsense]"
WORKDIR /data
ENTRYPOINT ["ddgrasp"]
CMD ["--help"]
