"""Features that NumPy 2 removed or changed and that the packages around Nengo still use."""

import importlib

import numpy

IS_NEEDED = int(numpy.__version__.split(".")[0]) >= 2


class NumPy1:
    """NumPy with some functions as in NumPy 1.

    - ``array(copy=False)`` copies only if necessary.  NumPy 2 refuses where a copy is needed;
      NengoLoihi 1.1 needs one where it discretises a block's weights and where it computes rates.
    - Binary ``fromstring`` (gone since NumPy 2.3), with which NengoLoihi reads a DVS camera's
      files.
    - ``find_common_type`` (gone since 2.0) and ``in1d`` (gone since 2.4), which Nengo 4.1 calls in
      its copy of SciPy's matrix exponential when it discretises a large linear filter.
    """

    def __getattr__(self, name):
        return getattr(numpy, name)

    @staticmethod
    def array(*values, copy=True, **options):
        return numpy.array(*values, copy=copy or None, **options)

    @staticmethod
    def fromstring(data, dtype):
        return numpy.frombuffer(data, dtype).copy()

    @staticmethod
    def find_common_type(array_types, scalar_types):
        return numpy.result_type(*array_types, *scalar_types)

    @staticmethod
    def in1d(values, among):
        return numpy.isin(numpy.ravel(values), among)


def put_back(*names):
    """Let modules use NumPy with the functions of NumPy 1; on NumPy 1 nothing changes.

    Parameters
    ----------
    *names : str
        Modules that call NumPy ``np``.
    """
    if IS_NEEDED:  # NumPy 1, of older hosts, refuses copy=None
        for name in names:
            importlib.import_module(name).np = NumPy1()


def put_back_for_nengo():
    """Apply :func:`put_back` to the matrix exponential of Nengo 4."""
    folder = "nengo._vendor.scipy.sparse"
    put_back(*(f"{folder}.linalg_{part}" for part in ("expm", "interface", "onenormest")))


def put_back_for_nengo_loihi():
    """Apply :func:`put_back` to NengoLoihi 1.1, and to Nengo, which it calls."""
    put_back("nengo_loihi.block", "nengo_loihi.neurons", "nengo_loihi.dvs")
    put_back_for_nengo()
