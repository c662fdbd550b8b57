"""photoplan: orthophotos, mosaics, terrain models and views from images, with their accuracy.

From arrays::

    import photoplan

    ortho = photoplan.rectify(image, camera, photoplan.MapGrid.covering(bounds, 0.1, "EPSG:32633"), "dtm.tif")
    ortho.save("ortho.tif")

From a project::

    project = photoplan.load_project("brighton/project.toml")
    plan = photoplan.plan_orthophotos(project, resolution=0.1)
    print(plan)
    products = photoplan.execute(plan, "products")

Every command is a function, most of one value that says what is asked: `find_ties(TieRequest(project))`. Names are
loaded when they are first used, so that importing the package costs nothing; `photoplan.cameras`, `photoplan.surfaces`,
`photoplan.targets`, `photoplan.orientation`, `photoplan.matching`, `photoplan.radiometry`, `photoplan.terrain`,
`photoplan.quality` have more.
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
        "products.orthophoto.make": "make_products run_plan",
        "products.orthophoto.mosaic": "plan_mosaic plan_objects",
        "products.orthophoto.plan_file": "read_plan",
        "products.run": "Run",
        "products.init": "InitRequest init_project",
        "products.check": "check_project",
        "products.convert": "ConvertRequest convert_orientation",
        "products.film": (
            "FiducialsRequest locate_fiducials InteriorRequest interior_orientations ResectRequest resect_project"
        ),
        "products.tie": "TieRequest find_ties",
        "products.control": "ControlRequest propose_control",
        "products.adjust.run": "AdjustRequest adjust_project",
        "products.budget": "write_polynomials BudgetRequest make_budget",
        "requests.surface": "SurfaceRequest SurfaceSettings",
        "products.surface.plan": "plan_surface",
        "products.surface.run": "make_surface surface_project",
        "requests.view": "CameraRequest LookRequest ViewRequest MatrixRequest SequenceRequest AreaRequest PickRequest "
        "SkylineRequest",
        "products.view.make": "view_picture view_matrix plan_view make_view",
        "products.view.sequence": "view_sequence plan_sequence make_sequence",
        "products.view.skyline": "skyline",
        "products.view.measure": "visible_area pick",
        "products.register": "RegisterRequest register",
        "products.balance": "balance_project",
        "requests.ortho": "BalanceRequest Choice MosaicRequest ObjectRequest OrthoRequest OrthoSettings RunRequest",
        "products.seams": "SeamsRequest make_seams",
        "products.illumination": "IlluminationRequest correct_illumination",
        "products.measured_filter": "design_restoration ChromaticRequest measure_chromatic",
        "products.restore": "RestoreRequest plan_restoration restore_images",
        "products.mtf.patterns": "MtfRequest measure_mtf",
        "products.sensor": "SensorRequest describe_sensor",
        "products.characterise.run": "CharacteriseRequest characterise",
        "products.simulate": "SimulateRequest simulate",
        "products.dtm.build": "BuildRequest dtm_build RefineRequest dtm_refine",
        "products.dtm.lines": "SampleRequest dtm_sample ProfileRequest dtm_profile ContourRequest make_contours",
        "products.dtm.analyses": "VolumeRequest dtm_volume VisibleRequest dtm_visible FlowRequest dtm_flow",
        "products.dtm.rasters": "PictureRequest make_picture dtm_shade dtm_slope dtm_tint ExportRequest dtm_export",
        "requests.terrain": "ShadeRequest SlopeRequest TintRequest",
        "products.describe": "dtm_info",
        "products.monoplot": "MonoplotRequest monoplot_file",
        "project.ground": "open_terrain",
        "cameras.frame": "FrameCamera",
        "cameras.lenses": "Interior",
        "geometry.pose": "Pose",
        "geometry.grid": "MapGrid Placement Window",
        "targets.map": "MapTarget",
        "surfaces.base": "LevelSurface",
        "surfaces.raster": "RasterSurface",
        "cameras": "",
        "matching": "",
        "orientation": "",
        "quality": "",
        "radiometry": "",
        "surfaces": "",
        "targets": "",
        "terrain": "",
    },
)
