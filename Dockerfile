# jcr in a container: docker build -t jcr . && docker run --rm -v "$PWD:/data" jcr run captures/table out/table
# With a GPU: docker build --build-arg TORCH=cuda -t jcr:cuda . && docker run --gpus all …
FROM python:3.11-slim-bookworm

# cpu: torch without CUDA (0.9 GB installed); cuda: with it (5 GB); none: no maps, calibration and report alone.
ARG TORCH=cpu
ARG TORCH_VERSION=2.13.0
ARG EXTRAS=networks,view,ros,lerobot,planning,realsense,franka,xarm

ENV PIP_NO_CACHE_DIR=1 PIP_DISABLE_PIP_VERSION_CHECK=1 OMP_NUM_THREADS=4
SHELL ["/bin/bash", "-o", "pipefail", "-c"]

# libusb opens a RealSense, v4l-utils tells which cameras there are.
# hadolint ignore=DL3008
RUN apt-get update \
 && apt-get install -y --no-install-recommends libusb-1.0-0 v4l-utils \
 && rm -rf /var/lib/apt/lists/*

WORKDIR /opt/jcr
COPY pyproject.toml constraints.txt README.md LICENSE ./
COPY src src
COPY docs docs
# torch by itself and first: an open range would bring several GB of CUDA packages where none are wanted.
RUN case "$TORCH" in \
      cpu) pip install "torch==$TORCH_VERSION" --index-url https://download.pytorch.org/whl/cpu ;; \
      cuda) pip install "torch==$TORCH_VERSION" ;; \
      none) ;; \
      *) echo "TORCH=$TORCH: give cpu, cuda or none" >&2; exit 1 ;; \
    esac \
 && if [ "$TORCH" = none ]; then extras=ros,lerobot,realsense,franka,xarm; else extras="$EXTRAS"; fi \
 && pip install --constraint constraints.txt ".[$extras]"

RUN useradd --create-home --uid 1000 --groups video,plugdev jcr && mkdir /data && chown jcr /data
USER 1000
WORKDIR /data
ENTRYPOINT ["jcr"]
CMD ["--help"]
