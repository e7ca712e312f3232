"""Lets `python -m gsdmsr_cli` do what `gsdmsr` does."""

from gsdmsr_cli.cli.main import main

if __name__ == "__main__":
    main()
