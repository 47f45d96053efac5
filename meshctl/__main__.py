"""The process `meshctl`, also as `python -m meshctl`."""

from meshctl.start_up import end_at_ctrl_c


def start() -> None:
    """Run the command line."""
    end_at_ctrl_c()
    from meshctl.cli.main import main

    main()


if __name__ == "__main__":
    start()
