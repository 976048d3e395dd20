# For machines with an NVIDIA GPU and the NVIDIA container toolkit:
#   docker build -t manifeel . && docker run --rm --gpus all manifeel manifeel doctor
# The digest names the image's content, which a tag does not. For another version: `docker buildx imagetools inspect
# python:3.11.13-slim-bookworm` prints the digest of a tag.
FROM python:3.11.13-slim-bookworm@sha256:86adf8dbadc3d6e82ee5dd2c74bec2e1c2467cdad47886280501df722372d2e1

# libraries that opencv and SAPIEN load; the driver's own come from the host, through the toolkit. git: results name the commit
RUN apt-get update \
 && apt-get install -y --no-install-recommends git libvulkan1 libegl1 libgl1 libglib2.0-0 libxext6 \
 && rm -rf /var/lib/apt/lists/*
ENV NVIDIA_VISIBLE_DEVICES=all NVIDIA_DRIVER_CAPABILITIES=compute,utility,graphics
# the toolkit mounts the libraries, but not always the files through which Vulkan and EGL find them
RUN mkdir -p /usr/share/vulkan/icd.d /usr/share/glvnd/egl_vendor.d \
 && echo '{"file_format_version": "1.0.0", "ICD": {"library_path": "libGLX_nvidia.so.0", "api_version": "1.3"}}' \
    > /usr/share/vulkan/icd.d/nvidia_icd.json \
 && echo '{"file_format_version": "1.0.0", "ICD": {"library_path": "libEGL_nvidia.so.0"}}' \
    > /usr/share/glvnd/egl_vendor.d/10_nvidia.json

WORKDIR /manifeel
COPY . .
# every package by its hash, then torch for CUDA of the version in scripts/setup.sh
RUN pip install --no-cache-dir --no-compile --no-deps --require-hashes -r requirements.lock \
 && pip install --no-cache-dir --no-compile "$(sed -n 's/^TORCH_VERSION=/torch==/p' scripts/setup.sh)" \
 && pip install --no-cache-dir --no-compile --no-deps --no-build-isolation -e .
