"""photoplan: photographs with known geometry become measurable pictures.

From arrays::

    import photoplan

    ortho = photoplan.rectify(image, camera, photoplan.MapGrid.covering(bounds, 0.1, "EPSG:32633"), "dtm.tif")
    ortho.save("ortho.tif")

From a project::

    project = photoplan.load_project("brighton/project.toml")
    plan = photoplan.plan_orthophotos(project, resolution=0.1)
    print(plan)
    products = photoplan.execute(plan, "products")

Names are loaded when they are first used, so that importing the package costs nothing; `photoplan.cameras`,
`photoplan.surfaces`, `photoplan.targets`, `photoplan.orientation`, `photoplan.terrain`, `photoplan.quality` have more.
"""

from photoplan.public import public

__version__ = "0.1.0"

__getattr__, __dir__, __all__ = public(
    __name__,
    {
        "products.rectify": "Raster rectify",
        "io.project.file": "load_project",
        "products.orthophoto.plan": "plan_orthophotos render",
        "products.orthophoto.execution": "execute",
        "products.orthophoto.mosaic": "plan_mosaic",
        "products.orthophoto.objects": "plan_objects",
        "products.orthophoto.plan_file": "read_plan",
        "project.open_terrain": "open_terrain",
        "cameras.frame": "FrameCamera",
        "cameras.interior": "Interior",
        "geometry.pose": "Pose",
        "geometry.grid": "MapGrid Placement Window",
        "targets.map": "MapTarget",
        "surfaces.level": "LevelSurface",
        "surfaces.raster": "RasterSurface",
        "cameras": "",
        "orientation": "",
        "quality": "",
        "surfaces": "",
        "targets": "",
        "terrain": "",
    },
)
