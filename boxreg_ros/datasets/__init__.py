"""
Public data sets as recordings, from the folder as it is downloaded: one module per data set.

Each is behind `protocol.DatasetModule` and listed in `registry.DATASETS`. To add a data set, write
a module with ``DATASET``, ``scene_names``, ``inputs`` and ``open_scene``, and add it to the table.

"""
