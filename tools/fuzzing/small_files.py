"""Small whole files of every text format that is read, for the tests that damage them."""

LOG = b"""PARAM uwb_tag_height 0.3 0 h 0
PARAM robot_front_laser_max 5.6 0 h 0
ODOM 0 0 0 0 0 0 0.0 h 0
ODOM 0.5 0 0.1 0 0 0 1.0 h 1
UWB 5C0B 3.2 100 1.1 h 1.1
ROBOTLASER1 2 -1.5 3.0 1.0 5.6 0.01 0 4 1.0 2.0 5.6 0.01 0 0.6 0 0 0.5 0 0.1 0 0 0 0 0 1.5 h 1.5
RAWLASER1 0 -1.5 3 1 5.6 0.01 0 3 1 2 3 0 1.8 h 1.8
ODOM 1.0 0.1 0.3 0 0 0 2.0 h 2
UWB 5C0B 3.0 100 2.1 h 2.1
FLASER 3 1 2 3 1 0.1 0.3 1 0.1 0.3 2.5 h 2.5
ODOM 1.5 0.3 0.5 0 0 0 3.0 h 3
"""
G2O = b"""VERTEX_SE2 0 0 0 0
VERTEX_SE2 1 1.1 0 0
VERTEX_XY 7 3 3
FIX 0
EDGE_SE2 0 1 1 0 0 100 0 0 100 0 100
EDGE_SE2_XY 1 7 2 3 10 0 10
EDGE_RANGE_SE2_XY 0 7 4.2 25
EDGE_PRIOR_SE2 0 0 0 0 1 0 0 1 0 1
"""
TORO = b"VERTEX2 0 0 0 0\nVERTEX2 1 1 0 0\nEDGE2 0 1 1 0 0 100 0 100 100 0 0\n"
PYFG = b"""VERTEX_SE2 0 A0 0 0 0
VERTEX_SE2 1 A1 1.1 0 0
VERTEX_XY L0 3 3
VERTEX_SE2:PRIOR 0 A0 0 0 0 0.01 0 0 0.01 0 0.01
EDGE_SE2 0 A0 A1 1 0 0 0.01 0 0 0.01 0 0.01
EDGE_RANGE 0 A0 L0 4.2 0.01
"""
TUM = b"# stamp x y z qx qy qz qw\n1 0 0 0 0 0 0 1\n2 1 0 0 0 0 0.1 0.995\n3 2 0 0 0 0 0 1\n"
SETTINGS = b'use_uwb = true\ncrop = [0, 0, 1, 1]\nalign = "walls"\n[grid]\nresolution = 0.05\n[keyframes]\ndistance = 0.3\n'
KNOWN = b"""[[anchor]]
id = "5C0B"
position = [1, 2]
[[pose]]
stamp = 1
pose = [0, 0, 0]
[[landmark]]
name = "a"
position = [1.0, 2.0]
radius = 0.3
[[landmark_distance]]
landmarks = ["a", "b"]
distance = 3.0
[[forbidden_closure]]
stamps = [1, 2]
recordings = [1, 2]
"""
MAPPING = b"""[[uwb]]
topic = "/r/*"
readings = "ranges"
anchor = "id"
unit = 0.001
anchor_format = "{:04X}"
only = { tag = 3 }
"""
TABLE = b'name,x,y,radius,neighbours\nC1,2.1,1.7,0.15,"C2 C3"\n# remark\nC2,4.9,2.4,0.2,\n'
ANCHORS = b"id,x,y,sigma_x,sigma_y,status\n5C0B,3,4,0.1,0.1,ok\n91A3,3,6,,,ok\n0D27,6,-3,0.1,0.1,ok\n"
RELATIONS = b"# stamp1 stamp2 x y z roll pitch yaw\n1 2 1 0 0 0 0 0.1\n1.5 3 1.5 0.1 0 0 0 0\n"
LIBRSF = b"".join(
    b"odom2diff %.1f 0.4 0.6 0.2 0.01 0.01 0.01\nrange2 %.1f 2.%d 0.1 3.0 4.0 105.0\ngt2 %.1f 0 0 0 0\n" % (t, t, k % 10, t)
    for k, t in enumerate(x / 10 for x in range(20))
)
CORRECTED = b"".join(
    b"ODOM %.2f 0 0 0 0 0 1.01893e+09 h 1.01893e+09\nFLASER 3 1 2 3 %.2f 0 0 %.2f 0 0 %s h 0\n"
    b"ODOM %.2f 0 0 0 0 0 -5.77 h -5.77\n" % (0.3 * k - 0.1, 0.3 * k, 0.3 * k, b"%.1f" % k if k % 5 else b"0", 0.3 * k)
    for k in range(30)
)
ISAM = b"ODOMETRY 0 1 1 0 0 3 0 0 3 0 5\nLANDMARK 1 100 1 0.5 4 0 4\n"
OTHERS = b"""## Player version 2.1.0
LaserOdometryLog
@SENS 21-12-97 12:34:56.123456
LASER_READING 2 1.00 1.00 0 0 0 1.2e9
LASER-RANGE 9 1 0 2 180.0: 12.0 13.0
"""
