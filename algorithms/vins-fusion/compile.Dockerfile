# The stage that compiles; docker/ros1/Dockerfile goes on from here.
ARG BUILD_IMAGE
ARG RUN_IMAGE
FROM ${BUILD_IMAGE} AS build
ARG SOURCE=https://github.com/HKUST-Aerial-Robotics/VINS-Fusion#be55a93
COPY sources /sources
COPY package/patches /patches
RUN fetch-source "${SOURCE}" /tmp/upstream && mkdir -p /ws/src && cd /tmp/upstream && mv camera_models vins_estimator /ws/src/
RUN build-packages
