# The stage that compiles; docker/ros1/Dockerfile goes on from here.
ARG BUILD_IMAGE
ARG RUN_IMAGE
FROM ${BUILD_IMAGE} AS build
ARG SOURCE=https://github.com/HKUST-Aerial-Robotics/VINS-Mono#90dabb5
COPY sources /sources
COPY package/patches /patches
RUN fetch-source "${SOURCE}" /tmp/upstream && mkdir -p /ws/src && cd /tmp/upstream && mv camera_model feature_tracker vins_estimator /ws/src/
RUN build-packages
