"""Kernels of hits: which voxels a beam certainly crosses, and how many of its crossings are noticed."""
