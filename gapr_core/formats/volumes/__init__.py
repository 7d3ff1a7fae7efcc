"""Label maps: voxels in, one rigid bone surface in LPS millimetres out."""
