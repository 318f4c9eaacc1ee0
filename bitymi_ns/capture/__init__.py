"""Photographs or a video in, camera poses out: `poses.find_poses`, and `known.triangulate` for known poses."""
