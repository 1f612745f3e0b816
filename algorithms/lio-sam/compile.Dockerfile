# The stage that compiles; docker/ros1/Dockerfile goes on from here.
ARG GTSAM_IMAGE
ARG RUN_IMAGE
FROM ${GTSAM_IMAGE} AS build
ARG SOURCE=https://github.com/TixiaoShan/LIO-SAM#0be1fbe
COPY sources /sources
COPY package/patches /patches
RUN fetch-source "$SOURCE" /ws/src/LIO-SAM
RUN build-packages
