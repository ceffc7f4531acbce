"""Pieces of what devices say, from which hostile input is made."""

WORDS = {
    "scip": [b"MD0044072501000\n", b"99b\n", b"00P\n", b"\n\n", b"GD", b"VV\n", b"QT", b"0" * 64, b"TM1\n", b";"],
    "tlv": [b"\x40\x01\x00", b"\x41\x0d", b"\x49\x51\x04", b"\x5a\x02", b"\x48\x0e\x01", b"\x40", b"\x56\xff"],
    "shell": [b"dwm> ", b"DIST,", b"AN0,0A1B,", b"0.00,", b"POS,", b"=2.80 ", b"0A1B[0.00,0.00,0.00]", b"\r\n", b"\x85"],
    "kobuki": [b"\xaa\x55", b"\xaa\x55\x4d\x01\x0f", b"\x04\x07", b"\x0d\x0e", bytes(15), b"\xaa\x55\xff\x01\x0f"],
    "line": [b"1.0,", b"2,", b"nan,", b"\n", b"\r\n", b"-3e9,", b"1,2,3,4\n", b"\x85"],
    "create2": [b"\x13\x0b\x07", b"\x13\x0b\x07\x00\x2b\x00\x10\x2c\x00\x10\x16\x3d\xb8", bytes(3), b"\x2c\xff\xff"],
    "uwb-line": [b"A1 2.5\n", b"A1", b" ", b"nan\n", b"1e999\r\n", b";,;", b"\x85"],
    "makerfabs": [b"from: 1782\t Range: 3.21 m\t RX power: -65.1 dBm\r\n", b"from: ", b"Range:", b" -1 m", b"\n"],
    "makerfabs-at": [b"AT+RANGE=tid:0,mask:0F,seq:1,range:(", b"232,401", b"),ancid:(", b"0,-1,", b"--", b"(1)\r\n", b"\n"],
    "bu01": [b"an0:1.23m\r\n", b"an", b":", b"9" * 400, b".5m", b"\n"],
    "dwm3001": [b'mac_address=0x0001, status="SUCCESS", distance[cm]=', b"245", b"-1]\n", b'"RX_TIMEOUT"]', b"{", b"\n"],
    "linktrack": [b"\x55\x01", b"\x55\x04", bytes(100), b"\x55\x01" + bytes(125) + b"\x56"],
    "bu03": [b"\xaa\x25\x01", b"\xee\x07\x00\x00", bytes(4), bytes(32)],
    "ld06": [b"\x54\x2c", b"\x54\x2c\x68\x08\xab\x7e", b"\xe0\x00\xe4" * 12, b"\xbe\x82\x3a\x1a\x50"],
    "ydlidar-x2": [b"\xaa\x55", bytes.fromhex("aa55010153ae53aeab540000"), b"\xaa\x55\x00\xff\x01\x01\x01\x01", b"\xa5\x5a"],
    "ydlidar-x4": [b"\xa5\x5a\x05\x00\x00\x40\x81", b"\xa5\x5a\x14\x00\x00\x00\x04", bytes(20), b"\xaa\x55\x00\x28"],
    "rplidar": [b"\xa5\x5a\x54\x00\x00\x40\x82", b"\xa5\x5a\x05\x00\x00\x40\x81", b"\xa0\x50" + bytes(82),
                b"\x3e\x01\x00\x00\x10", b"\xa5\x5a\x14\x00\x00\x00\x04" + bytes(20),
                b"\xa5\x5a\x03\x00\x00\x00\x06\x02\x00\x00"],
    "lds01": [b"\xfa\xa0", b"\xfa\xdb\xb8\x0b", bytes(38), b"\xfa\xa1" + bytes(38) + b"\x64\x64"],
}  # fmt: skip
