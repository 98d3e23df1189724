"""Recordings as files: a zip or folder of them is found, read and written.

::

    LUT.mat, taxels.csv           rows and columns, or positions, of the taxels, optional
    classes.txt                   names of the classes in the order of their labels, optional
    train/, test/                 the parts of a published split, optional
        <class>/<recording>       all with one ending

or the class is in the name of each file, ``<name>_label_<class>.npy``, without folders of classes.

There may be any number of folders around everything, as ``data_submission`` in ST-MNIST's archive.
Hidden files, ``README*``, ``LICENSE*``, ``*.txt`` and ``*.md`` are ignored, unless all files are
``*.txt``, which then are the recordings; anything else is refused by name.  A zip is read without
being unpacked to disk.
"""
