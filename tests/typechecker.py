"""The checker behind the import hook in conftest.py: beartype, with ints allowed where floats are, as PEP 484 says."""

from beartype import BeartypeConf, beartype

check = beartype(conf=BeartypeConf(is_pep484_tower=True))
