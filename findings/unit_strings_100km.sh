#!/usr/bin/env bash
# Strings of units per 100 km: pint 0.25.3 reads "15 kWh/100km" as 0.15 km·kWh, without an error;
# quantities 0.16.4 drops the 100 of "kW*h/(100*km)"; unyt 3.2.0 is right, astropy 8.0.2 refuses.
# Guess before: "15 kWh/100km" is 0.15 kWh/km, or refused.
# Seen: pint divides by 100 and multiplies by km, also for litres; quantities: 54,000, not 540 N.
# Hurt: consumption per 100 km read from tables with units in their headings.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv" &&
    "$folder/venv/bin/python" -m pip install -qq \
        pint==0.25.3 quantities==0.16.4 astropy==8.0.2 unyt==3.2.0 || exit 2
cd "$folder"
venv/bin/python - <<'EOF'
import sys

import astropy.units
import pint
import quantities
import unyt

EXACT = 15 * 3.6e6 / 1e5  # 15 kWh/100km [N]
units = pint.UnitRegistry()
read = [units(text) for text in ("15 kWh/100km", "15 kWh/(100 km)", "6 L/100km")]
for value in read:
    print(f"pint: {value}, in SI {value.to_base_units()}")
other = quantities.Quantity(15, "kW*h/(100*km)")
right = unyt.unyt_quantity(15, "kW*hr/(100*km)").to("N")
print(f"quantities: {other}, in SI {other.simplified}; unyt: {right}; exact: {EXACT} N")
try:
    astropy.units.Quantity("15 kW h/100km")
    refused = False
except ValueError:
    refused = True
print("astropy refuses" if refused else "astropy reads it")
lengths = [value.dimensionality["[length]"] for value in read]
force = read[1].to("N").magnitude
factor = float(other.simplified) / EXACT
known = refused and abs(force - EXACT) < 1e-6 and abs(float(right) - EXACT) < 1e-6
# The dimension of an energy times a length, of a force, and of a volume times a length.
sys.exit(0 if lengths == [3, 1, 4] and abs(factor - 100) < 1e-6 and known else 1)
EOF
