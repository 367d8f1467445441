"""Demonstrations on disk: our own HDF5 files, conversions from and to the files of other tools, and the table of episodes that is learned from.

Every format is read into one form, a `recording.Recording`, and written from it. Reading checks everything and names file, demonstration and dataset
in one line; writing leaves either the whole file or what was there before.

    recording     Demonstration, Recording and its summary
    episodes      a recording as a padded table, checked against the environment, and back
    hdf5          our files: save, load, describe
    convert       any format: open, read, write, restore
    foreign       what another tool has written, and what a user can say about it
    interpret     what that means as a recording
    robomimic, minari, npz    readers and writers of these formats
"""
