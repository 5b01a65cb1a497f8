"""A ModemManager with one LTE modem on the system bus, for mmcli. Debian's Python runs it, because it has dbusmock.

It has the interfaces of ModemManager 1.20: org.freedesktop.ModemManager1.Modem, .Signal and .Modem3gpp.
"""

# mypy: ignore-errors
import sys
from pathlib import Path

import dbus
import dbus.mainloop.glib
import dbusmock
from gi.repository import GLib

ROOT = "/org/freedesktop/ModemManager1"
MODEM = "org.freedesktop.ModemManager1.Modem"
LTE, CONNECTED, UNKNOWN_LOCK, POWER_ON = 1 << 14, 11, 1, 3
CELL_LTE, CELL_5G = 5, 6


def _variants(**values: object) -> dbus.Dictionary:
    return dbus.Dictionary({key.replace("_", "-"): value for key, value in values.items()}, signature="sv")


def _empty(signature: str) -> dbus.Array:
    return dbus.Array([], signature=signature)


MODEM_PROPERTIES = {
    "AccessTechnologies": dbus.UInt32(LTE),
    "Bearers": _empty("o"),
    "CarrierConfiguration": "",
    "CarrierConfigurationRevision": "",
    "CurrentBands": dbus.Array([dbus.UInt32(33), dbus.UInt32(37)], signature="u"),
    "CurrentCapabilities": dbus.UInt32(12),
    "CurrentModes": dbus.Struct((dbus.UInt32(8), dbus.UInt32(0)), signature="uu"),
    "Device": "/sys/devices/x",
    "DeviceIdentifier": "0",
    "Drivers": dbus.Array(["qmi_wwan"], signature="s"),
    "EquipmentIdentifier": "",
    "HardwareRevision": "10000",
    "Manufacturer": "QUALCOMM INCORPORATED",
    "MaxActiveBearers": dbus.UInt32(1),
    "MaxActiveMultiplexedBearers": dbus.UInt32(0),
    "MaxBearers": dbus.UInt32(1),
    "Model": "QUECTEL Mobile Broadband Module",
    "OwnNumbers": _empty("s"),
    "Plugin": "quectel",
    "Ports": _empty("(su)"),
    "PowerState": dbus.UInt32(POWER_ON),
    "PrimaryPort": "cdc-wdm0",
    "PrimarySimSlot": dbus.UInt32(0),
    "Revision": "EG25GGBR07A08M2G",
    "SignalQuality": dbus.Struct((dbus.UInt32(67), True), signature="ub"),
    "Sim": dbus.ObjectPath("/"),
    "SimSlots": _empty("o"),
    "State": dbus.Int32(CONNECTED),
    "StateFailedReason": dbus.UInt32(0),
    "SupportedBands": dbus.Array([dbus.UInt32(33)], signature="u"),
    "SupportedCapabilities": dbus.Array([dbus.UInt32(4)], signature="u"),
    "SupportedIpFamilies": dbus.UInt32(7),
    "SupportedModes": _empty("(uu)"),
    "UnlockRequired": dbus.UInt32(UNKNOWN_LOCK),
    "UnlockRetries": dbus.Dictionary({}, signature="uu"),
}
SIGNAL_PROPERTIES = {
    "Rate": dbus.UInt32(2),
    "RssiThreshold": dbus.UInt32(0),
    "ErrorRateThreshold": False,
    **{name: _variants() for name in ("Cdma", "Evdo", "Gsm", "Umts", "Nr5g")},
    "Lte": _variants(rssi=-67.0, rsrq=-11.0, rsrp=-97.0, snr=12.4),
}
NETWORK_PROPERTIES = {
    "EnabledFacilityLocks": dbus.UInt32(0),
    "EpsUeModeOperation": dbus.UInt32(0),
    "Imei": "",
    "InitialEpsBearer": dbus.ObjectPath("/"),
    "InitialEpsBearerSettings": _variants(),
    "Nr5gRegistrationSettings": _variants(),
    "OperatorCode": "26202",
    "OperatorName": "Vodafone.de",
    "PacketServiceState": dbus.UInt32(2),
    "Pco": _empty("(ubay)"),
    "RegistrationState": dbus.UInt32(1),
    "SubscriptionState": dbus.UInt32(0),
}
CELLS = f"""ret = [
    dbus.Dictionary({{"cell-type": dbus.UInt32({CELL_LTE}), "serving": True, "operator-id": "26202", "tac": "B09A",
        "ci": "01A2D001", "physical-ci": "012", "earfcn": dbus.UInt32(1575), "rsrp": -97.0, "rsrq": -11.0}},
        signature="sv"),
    dbus.Dictionary({{"cell-type": dbus.UInt32({CELL_LTE}), "serving": False, "physical-ci": "0DC",
        "earfcn": dbus.UInt32(1575), "rsrp": -104.5, "rsrq": -16.0}}, signature="sv"),
    dbus.Dictionary({{"cell-type": dbus.UInt32({CELL_5G}), "serving": False, "physical-ci": "1F4",
        "nrarfcn": dbus.UInt32(528030), "rsrp": -76.0, "rsrq": -11.0, "sinr": 21.0}}, signature="sv"),
]"""

dbus.mainloop.glib.DBusGMainLoop(set_as_default=True)
bus = dbus.SystemBus()
name = dbus.service.BusName("org.freedesktop.ModemManager1", bus, do_not_queue=True)
manager = dbusmock.mockobject.DBusMockObject(name, ROOT, "org.freedesktop.ModemManager1", {}, is_object_manager=True)
dbusmock.mockobject.objects[ROOT] = manager
path = f"{ROOT}/Modem/0"
manager.AddObject(path, MODEM, MODEM_PROPERTIES, [("GetCellInfo", "", "aa{sv}", CELLS)])
modem = dbusmock.mockobject.objects[path]
modem.AddProperties(f"{MODEM}.Signal", SIGNAL_PROPERTIES)
modem.AddProperties(f"{MODEM}.Modem3gpp", NETWORK_PROPERTIES)
Path(sys.argv[1]).touch()
GLib.MainLoop().run()
