// In place of Viewer.cc and MapDrawer.cc: nothing is drawn.

#include "MapDrawer.h"
#include "Viewer.h"

namespace ORB_SLAM2 {

Viewer::Viewer(System*, FrameDrawer*, MapDrawer*, Tracking*, const string&) {}
void Viewer::Run() {}
void Viewer::RequestFinish() {}
void Viewer::RequestStop() {}
bool Viewer::isFinished() { return true; }
bool Viewer::isStopped() { return true; }
void Viewer::Release() {}

MapDrawer::MapDrawer(Map*, const string&) {}
void MapDrawer::SetCurrentCameraPose(const cv::Mat&) {}
void MapDrawer::SetReferenceKeyFrame(KeyFrame*) {}

}  // namespace ORB_SLAM2
