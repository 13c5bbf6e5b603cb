"""One pyramid over a unit square, 1 m high, as the content of a mesh file in each format."""

import struct

CORNERS = [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0), (0.5, 0.5, 1)]
SIDES = [(0, 1, 4), (1, 2, 4), (2, 3, 4), (3, 0, 4), (0, 2, 1), (0, 3, 2)]


def binary_stl() -> bytes:
    triangles = [struct.pack("<12fH", 0, 0, 0, *(x for each in side for x in CORNERS[each]), 0) for side in SIDES]
    return b"solid is no sign of text".ljust(80) + struct.pack("<I", len(SIDES)) + b"".join(triangles)


def text_stl() -> bytes:
    loops = [" ".join(f"vertex {x} {y} {z}\n" for x, y, z in (CORNERS[each] for each in side)) for side in SIDES]
    facets = [f"facet normal 0 0 0\nouter loop\n{loop}endloop\nendfacet\n" for loop in loops]
    return f"solid pyramid\n{''.join(facets)}endsolid".encode()


def obj() -> bytes:
    """The base is one polygon, and one side counts its vertices from the end."""
    lines = [f"v {x} {y} {z}" for x, y, z in CORNERS]
    lines += ["vn 0 0 1", "f -5//1 -4//1 -1//1"]
    lines += [f"f {' '.join(f'{each + 1}//1' for each in side)}" for side in SIDES[1:4]]
    return "\n".join([*lines, "f 1 4 3 2"]).encode()


def collada(*, up: str = "Z_UP", primitive: str = "triangles") -> bytes:
    """In centimetres, with vertex and normal indices, placed by two nodes that cancel each other."""
    numbers = " ".join(f"{x * 100:g} {y * 100:g} {z * 100:g}" for x, y, z in CORNERS)
    indices = " ".join(f"{each} 0" for side in SIDES for each in side)
    count = f"<vcount>{' '.join('3' for _ in SIDES)}</vcount>" if primitive == "polylist" else ""
    return f"""<?xml version="1.0"?><COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema" version="1.4.1">
<asset><unit name="centimeter" meter="0.01"/><up_axis>{up}</up_axis></asset>
<library_geometries><geometry id="g"><mesh>
<source id="p"><float_array id="a" count="15">{numbers}</float_array>
<technique_common><accessor source="#a" count="5" stride="3"><param name="X" type="float"/>
<param name="Y" type="float"/><param name="Z" type="float"/></accessor></technique_common></source>
<source id="n"><float_array id="b" count="3">0 0 1</float_array>
<technique_common><accessor source="#b" count="1" stride="3"><param name="X" type="float"/>
<param name="Y" type="float"/>
<param name="Z" type="float"/></accessor></technique_common></source>
<vertices id="v"><input semantic="POSITION" source="#p"/></vertices>
<{primitive} count="6"><input semantic="VERTEX" source="#v" offset="0"/>
<input semantic="NORMAL" source="#n" offset="1"/>{count}<p>{indices}</p></{primitive}>
</mesh></geometry></library_geometries>
<library_visual_scenes><visual_scene id="s"><node><translate>5 0 0</translate><rotate>0 0 1 90</rotate>
<node><rotate>0 0 1 -90</rotate><matrix>1 0 0 -5  0 1 0 0  0 0 1 0  0 0 0 1</matrix><scale>1 1 1</scale>
<instance_geometry url="#g"/></node></node></visual_scene></library_visual_scenes>
<scene><instance_visual_scene url="#s"/></scene></COLLADA>""".encode()
