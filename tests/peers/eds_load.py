"""Loads electronic data sheets with python-canopen and prints their content as JSON."""

import json
import sys

import canopen
from canopen.objectdictionary import ODVariable

NODE = 5


def values(od):
    """Every value of the dictionary: (index, subindex, variable)."""
    for index, entry in od.items():
        if isinstance(entry, ODVariable):
            yield index, 0, entry
        else:
            for subindex, variable in entry.items():
                yield index, subindex, variable


def sheet(path):
    od = canopen.import_od(path, node_id=NODE)
    assert od.device_information.product_name, path
    for index, subindex, variable in values(od):
        assert variable.name, f"{path}: {index:04X}sub{subindex} has no name"
        assert variable.default is not None, f"{path}: {index:04X}sub{subindex} has no value"
    return {
        "values": sum(1 for _ in values(od)),
        "receive_pdos": od.device_information.nr_of_RXPDO,
        "transmit_pdos": od.device_information.nr_of_TXPDO,
        "product_code": od["Identity object"]["Product code"].default,
        "sdo_request": od[0x1200][1].default,
        "emergency": od[0x1014].default,
        "rpdo1": od[0x1400][1].default,
        "controlword": {
            "index": od["Controlword"].index,
            "bits": len(od["Controlword"]),
            "mappable": od["Controlword"].pdo_mappable,
            "writable": od["Controlword"].writable,
        },
        "statusword_writable": od["Statusword"].writable,
        "software_limit_min": od[0x607D][1].min,
        "modes": od["Supported drive modes"].default,
    }


print(json.dumps([sheet(path) for path in sys.argv[1:]]))
