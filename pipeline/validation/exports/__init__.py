"""Labelled point clouds as folders for anyone's detector: KITTI, OpenPCDet's custom format, PLY, PCD."""
