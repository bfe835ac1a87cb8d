"""Recordings of data sets in their published layouts, and synthetic ones: readers, importers, renderings.

Every reader yields :class:`~hat_ros.bench.datasets.image_files.ImageRecording`: frames with calibration, given masks
where the data set brings them, and the ground truth, for evaluation only: no stage of the method sees it.
"""
