# The stage that compiles; docker/ros1/Dockerfile goes on from here.
ARG BUILD_IMAGE
ARG RUN_IMAGE
FROM ${BUILD_IMAGE} AS build
ARG SOURCE=https://github.com/HKUST-Aerial-Robotics/A-LOAM#e51f88c
COPY sources /sources
COPY package/patches /patches
RUN fetch-source "$SOURCE" /ws/src/A-LOAM
RUN build-packages
