"""Programs outside the toolkit that draw its scenes: what the bundled examples and the tests measure it against.

None of them imports ``brdf`` or ``fitting``. All take the same two dictionaries, a scene as ``scene.toml`` reads
(``tomllib.loads``) and a material as ``truth.json`` reads (``model``, ``k_a``, ``k_d``, ``k_s``, ``n``), and give a
linear picture ``(height, width, 3)`` in float32, row 0 at the top, black where nothing is hit.

=====================  ==========================  ================  ======================================
module                 program                     lobe              lights
=====================  ==========================  ================  ======================================
``opengl_ball``        OpenGL fixed function       Blinn-Phong       directional, point, spot; no shadows
``vtk_ball``           VTK                         Phong             directional, point; no shadows
``mitsuba_scene``      Mitsuba 3                   all five models   all kinds, with shadows
``numpy_shading``      a page of NumPy, float64    all five models   directional, point, spot; shadows if asked
=====================  ==========================  ================  ======================================
"""
