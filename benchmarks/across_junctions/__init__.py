"""The larger study: does a score predict detection at junctions, sensors and detectors that it was not made from?"""
