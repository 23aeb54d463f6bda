from .comparisons import (
    Comparison as Comparison,
    Definitions as Definitions,
    program_definitions as program_definitions,
)
from .ltl import Formula as Formula, holds_on_lasso as holds_on_lasso, parse_ltl as parse_ltl
from .properties import (
    Property as Property,
    parse_properties as parse_properties,
    parse_property as parse_property,
)
