"""Line cameras from files."""
