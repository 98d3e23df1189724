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
        values = self.__dict__  # past __setattr__; a core has tens of thousands of registers
        values.update(_name=name, _fields=fields, written=False)
        for field, value in fields.items():
            inner = Register(f"{name}.{field}", value) if isinstance(value, dict) else 0
            values[field] = inner

    def __setattr__(self, field, value):
        if field not in self._fields:
            raise BoardError(f"{self._name} has no field {field}")
        low, high = self._fields[field]
        if int(value) != value:
            raise BoardError(f"{self._name}.{field} = {value}: not a whole number")
        if not low <= value <= high:
            raise BoardError(f"{self._name}.{field} = {value}: outside {low} to {high}")
        self.__dict__[field] = int(value)
        self.__dict__["written"] = True

    def configure(self, **fields):
        for field, value in fields.items():
            setattr(self, field, value)
        self.__dict__["written"] = True


class RegisterFile:
    """A numbered row of registers of one kind; those never touched take no memory."""

    def __init__(self, name, size, fields):
        self.name = name
        self.size = size
        self.fields = fields
        self.registers = {}

    def __getitem__(self, index):
        if index in self.registers:
            return self.registers[index]
        index = int(index)
        if not 0 <= index < self.size:
            raise BoardError(f"{self.name}[{index}]: a core has {self.size} of these registers")
        register = self.registers[index] = Register(f"{self.name}[{index}]", self.fields)
        return register
