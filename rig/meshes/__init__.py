"""Objects as meshes, for the test rig: shapes that nobody trained on, with convex parts for contact.

`objects.MESH_OBJECTS` names them, `bodies.make_body` makes what MuJoCo takes of one. Needs the extra [fr3].
"""
