# In place of the file of libpcl-dev, which wants VTK, Qt and OpenNI: the parts of PCL that the run-time image has.
set(PCL_FOUND TRUE)
set(PCL_VERSION 1.13.0)
set(PCL_INCLUDE_DIRS /usr/include/pcl-1.13 /usr/include/eigen3)
set(PCL_LIBRARY_DIRS "")
set(PCL_DEFINITIONS "")
set(PCL_LIBRARIES
  pcl_registration pcl_segmentation pcl_features pcl_filters pcl_sample_consensus pcl_search pcl_kdtree pcl_octree
  pcl_common flann lz4 boost_system boost_filesystem boost_thread gomp)
