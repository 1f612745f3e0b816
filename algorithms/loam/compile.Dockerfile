# The stage that compiles; docker/ros1/Dockerfile goes on from here.
ARG BUILD_IMAGE
ARG RUN_IMAGE
FROM ${BUILD_IMAGE} AS build
ARG SOURCE=https://github.com/laboshinl/loam_velodyne#25db5dd
COPY sources /sources
COPY package/patches /patches
RUN fetch-source "$SOURCE" /ws/src/loam_velodyne
# Unity files spare the compiler most of the headers of PCL.
RUN build-packages -DCMAKE_UNITY_BUILD=ON "-DCMAKE_CXX_FLAGS_RELEASE=-O2 -DNDEBUG"
