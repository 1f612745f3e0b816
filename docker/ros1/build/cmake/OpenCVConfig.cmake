# In place of the file of libopencv-dev, which wants every module of OpenCV: those that the run-time image has.
set(OpenCV_FOUND TRUE)
set(OpenCV_VERSION 4.6.0)
set(OpenCV_INCLUDE_DIRS /usr/include/opencv4)
set(OpenCV_LIBS
  opencv_calib3d opencv_video opencv_features2d opencv_flann opencv_imgcodecs opencv_imgproc opencv_core)
set(OpenCV_LIBRARIES ${OpenCV_LIBS})
