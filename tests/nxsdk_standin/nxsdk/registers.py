"""Registers that know their fields and ranges, so that a wrong write cannot pass unnoticed."""

from .faults import BoardError


class Register:
    """Named integer fields, each with its range.

    Parameters
    ----------
    name : str
        Where the register is, for error messages.
    fields : dict
        Field name to ``(lowest, highest)``, or to another such dict for a register within.
    """

    def __init__(self, name, fields):
        object.__setattr__(self, "_name", name)
        object.__setattr__(self, "_fields", fields)
        object.__setattr__(self, "written", False)
        for field, value in fields.items():
            inner = Register(f"{name}.{field}", value) if isinstance(value, dict) else 0
            object.__setattr__(self, field, inner)

    def __setattr__(self, field, value):
        if field not in self._fields:
            raise BoardError(f"{self._name} has no field {field}")
        low, high = self._fields[field]
        if int(value) != value:
            raise BoardError(f"{self._name}.{field} = {value}: not a whole number")
        if not low <= value <= high:
            raise BoardError(f"{self._name}.{field} = {value}: outside {low} to {high}")
        object.__setattr__(self, field, int(value))
        object.__setattr__(self, "written", True)

    def configure(self, **fields):
        for field, value in fields.items():
            setattr(self, field, value)
        object.__setattr__(self, "written", True)


class RegisterFile:
    """A numbered row of registers of one kind; those never touched take no memory."""

    def __init__(self, name, size, fields):
        self.name = name
        self.size = size
        self.fields = fields
        self.registers = {}

    def __getitem__(self, index):
        index = int(index)
        if not 0 <= index < self.size:
            raise BoardError(f"{self.name}[{index}]: a core has {self.size} of these registers")
        if index not in self.registers:
            self.registers[index] = Register(f"{self.name}[{index}]", self.fields)
        return self.registers[index]
