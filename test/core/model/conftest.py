from toy_clouds import clouds, config, toy  # noqa: F401
