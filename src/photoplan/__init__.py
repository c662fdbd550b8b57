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
        "products.orthophoto.mosaic": "plan_mosaic",
        "products.orthophoto.objects": "plan_objects",
        "products.orthophoto.plan_file": "read_plan",
        "products.run": "Run",
        "products.init.run": "InitRequest init_project",
        "products.check": "check_project",
        "products.convert": "ConvertRequest convert_orientation",
        "products.fiducials": "FiducialsRequest locate_fiducials",
        "products.interior": "InteriorRequest interior_orientations",
        "products.resect": "ResectRequest resect_project",
        "products.tie.run": "TieRequest find_ties",
        "products.control.run": "ControlRequest propose_control",
        "products.adjust.run": "AdjustRequest adjust_project",
        "products.polynomials": "PolynomialsRequest write_polynomials",
        "products.budget": "BudgetRequest make_budget",
        "products.surface.settings": "SurfaceSettings",
        "products.surface.plan": "plan_surface",
        "products.surface.run": "make_surface",
        "products.view.camera": "CameraRequest",
        "products.view.make": "ViewRequest plan_view make_view",
        "products.view.sequence": "SequenceRequest plan_sequence make_sequence",
        "products.view.skyline": "SkylineRequest skyline",
        "products.view.area": "AreaRequest visible_area",
        "products.view.pick": "PickRequest pick",
        "products.register.run": "RegisterRequest register",
        "products.balance.run": "BalanceRequest balance_project",
        "products.seams.run": "SeamsRequest make_seams",
        "products.illumination": "IlluminationRequest correct_illumination",
        "products.restore.filter": "RestoreRequest",
        "products.restore.run": "plan_restoration restore_images",
        "products.restore.design": "DesignRequest design_restoration",
        "products.chromatic": "ChromaticRequest measure_chromatic",
        "products.mtf.run": "MtfRequest measure_mtf",
        "products.mtf.patterns": "PatternRequest measure_patterns",
        "products.sensor": "SensorRequest describe_sensor",
        "products.characterise.run": "CharacteriseRequest characterise",
        "products.simulate.run": "SimulateRequest simulate",
        "products.simulate.project": "SceneRequest simulate_project",
        "products.dtm.build": "BuildRequest dtm_build",
        "products.dtm.sample": "SampleRequest dtm_sample",
        "products.dtm.profile": "ProfileRequest dtm_profile",
        "products.dtm.contours": "ContourRequest make_contours",
        "products.dtm.volume": "VolumeRequest dtm_volume",
        "products.dtm.visible": "VisibleRequest dtm_visible",
        "products.dtm.flow": "FlowRequest dtm_flow",
        "products.dtm.refine": "RefineRequest dtm_refine",
        "products.dtm.shading": "PictureRequest make_picture dtm_shade dtm_slope dtm_tint",
        "requests.terrain": "ShadeRequest SlopeRequest TintRequest",
        "products.dtm.export": "ExportRequest dtm_export",
        "products.describe": "dtm_info",
        "products.monoplot": "MonoplotRequest monoplot_file",
        "project.open_terrain": "open_terrain",
        "cameras.frame": "FrameCamera",
        "cameras.interior": "Interior",
        "geometry.pose": "Pose",
        "geometry.grid": "MapGrid Placement Window",
        "targets.map": "MapTarget",
        "surfaces.level": "LevelSurface",
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
