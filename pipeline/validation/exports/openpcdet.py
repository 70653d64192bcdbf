"""The dataset configuration with which OpenPCDet takes a site's folder as its custom dataset.

The grid follows OpenPCDet's tutorial on custom datasets: along x and y a multiple of 16 voxels of 0.1 m, along z 40
voxels. It holds all labelled boxes in the region of interest. What a model's own configuration should say, its classes
and the anchor of each, stands at the top as a comment.
"""

from __future__ import annotations

import math

from pipeline.validation.classes import CLASSES
from pipeline.validation.exports.sites import WELL_SEEN, SiteSummary

FILE = "custom_dataset.yaml"
VOXEL_M = 0.1

_SIXTEEN_M = 16 * VOXEL_M
_LEVELS = 40
_LEAST_HEIGHT_M = 6.0
_MARGIN_M = 0.5  # below and above the boxes

_KITTI = {
    **{name: "Car" for name in ("Car", "Van", "Truck", "Trailer", "Bus", "Tram", "Misc")},
    **{name: "Cyclist" for name in ("Cyclist", "Motorcycle")},
    "Pedestrian": "Pedestrian",
}
"""What each class counts as in OpenPCDet's evaluation, which knows KITTI's three."""

_TEXT = """\
# For OpenPCDet's CustomDataset; in tools/cfgs/dataset_configs/. The grid holds all labelled boxes in the region.
#
# For the model's configuration, from the labels here (0 is the sensor's height, so the ground lies below it):
# CLASS_NAMES: [{present}]
# ANCHOR_GENERATOR_CONFIG: [
{anchors}# ]
DATASET: 'CustomDataset'
DATA_PATH: '../data/custom'

POINT_CLOUD_RANGE: [{grid}]

MAP_CLASS_TO_KITTI: {{
{map}
}}

DATA_SPLIT: {{
    'train': train,
    'test': val
}}

INFO_PATH: {{
    'train': [custom_infos_train.pkl],
    'test': [custom_infos_val.pkl],
}}

POINT_FEATURE_ENCODING: {{
    encoding_type: absolute_coordinates_encoding,
    used_feature_list: ['x', 'y', 'z', 'intensity'],
    src_feature_list: ['x', 'y', 'z', 'intensity'],
}}

DATA_AUGMENTOR:
    DISABLE_AUG_LIST: ['placeholder']
    AUG_CONFIG_LIST:
{pasting}        - NAME: random_world_flip
          ALONG_AXIS_LIST: ['x', 'y']

        - NAME: random_world_rotation
          WORLD_ROT_ANGLE: [-0.78539816, 0.78539816]

        - NAME: random_world_scaling
          WORLD_SCALE_RANGE: [0.95, 1.05]

DATA_PROCESSOR:
    - NAME: mask_points_and_boxes_outside_range
      REMOVE_OUTSIDE_BOXES: True

    - NAME: shuffle_points
      SHUFFLE_ENABLED: {{
        'train': True,
        'test': False
      }}

    - NAME: transform_points_to_voxels
      VOXEL_SIZE: [{voxel}]
      MAX_POINTS_PER_VOXEL: 5
      MAX_NUMBER_OF_VOXELS: {{
        'train': 150000,
        'test': 150000
      }}
"""

_ANCHOR = """\
#     {{'class_name': '{name}', 'anchor_sizes': [[{size}]], 'anchor_rotations': [0, 1.57],
#      'anchor_bottom_heights': [{bottom:g}], 'align_center': False, 'feature_map_stride': 8,
#      'matched_threshold': {matched:g}, 'unmatched_threshold': {unmatched:g}}},
"""

_LONG_M = 3.0
"""Classes of this mean length and more get the thresholds that OpenPCDet gives vehicles, others those of people."""

_PASTING = """\
        - NAME: gt_sampling
          USE_ROAD_PLANE: False
          DB_INFO_PATH:
              - custom_dbinfos_train.pkl
          PREPARE: {{
             filter_by_min_points: [{fewest}],
          }}
          SAMPLE_GROUPS: [{groups}]
          NUM_POINT_FEATURES: 4
          DATABASE_WITH_FAKELIDAR: False
          REMOVE_EXTRA_WIDTH: [0.0, 0.0, 0.0]
          LIMIT_WHOLE_SCENE: True

"""


def present(about: SiteSummary) -> list[str]:
    """The classes with labels, in the order of listings."""
    return [name for name in CLASSES if about.classes[name]]


def grid_m(about: SiteSummary) -> list[float]:
    """POINT_CLOUD_RANGE: lowest x, y, z, highest x, y, z; of a site without labels, a grid round the sensor."""
    low, high = about.low_m or [-1.0, -1.0, -_LEAST_HEIGHT_M], about.high_m or [1.0, 1.0, 0.0]
    west, south = (math.floor(value / _SIXTEEN_M) * _SIXTEEN_M for value in low[:2])
    east, north = (math.ceil(value / _SIXTEEN_M) * _SIXTEEN_M for value in high[:2])
    bottom = math.floor(low[2] - _MARGIN_M)
    top = max(bottom + _LEAST_HEIGHT_M, math.ceil(high[2] + _MARGIN_M))
    return [round(value, 3) for value in (west, south, bottom, east, north, top)]


def configuration(about: SiteSummary) -> str:
    """The text of :data:`FILE`."""
    grid, names = grid_m(about), present(about)
    well = [name for name in names if about.pasted[name]]
    pasting = _PASTING.format(
        fewest=", ".join(f"'{name}:{WELL_SEEN // 2}'" for name in well), groups=", ".join(f"'{n}:15'" for n in well)
    )
    return _TEXT.format(
        present=", ".join(f"'{name}'" for name in names),
        grid=", ".join(f"{value:g}" for value in grid),
        anchors="".join(_anchor(about, name) for name in names),
        map=",\n".join(f"    '{name}': '{_KITTI[name]}'" for name in CLASSES),
        pasting=pasting if well else "",
        voxel=f"{VOXEL_M:g}, {VOXEL_M:g}, {(grid[5] - grid[2]) / _LEVELS:g}",
    )


def _anchor(about: SiteSummary, name: str) -> str:
    """The lines of a class in the model's list of anchors."""
    *size, bottom = about.anchors[name]
    matched, unmatched = (0.55, 0.4) if size[0] >= _LONG_M else (0.5, 0.35)
    sizes = ", ".join(f"{value:g}" for value in size)
    return _ANCHOR.format(name=name, size=sizes, bottom=bottom, matched=matched, unmatched=unmatched)
