"""SSPs written by hand, and an FMU for their components that adds up what comes in.

`adder` is an FMU of FMI 2.0 in C that knows nothing of Loopwright: y(t + h) = y(t) + h (k u(t) + b) with the unit m for y
and m/s for u, two scalars ``s[1]``, ``s[2]`` that it doubles, an enumeration, an integer, a Boolean and a text.
"""

import io
import zipfile

from support.small_fmus import small_fmu, values

SOURCE = """
typedef struct { double t, u, y, k, b, s[2]; int mode, number, flag; double local; char text[16]; } instance;
void *fmi2Instantiate() { instance *c = calloc(1, sizeof *c); c->k = 1.0; c->b = 1.0; c->mode = 1; return c; }
int fmi2SetupExperiment() { return 0; }
int fmi2DoStep(void *p, double t, double h, int fresh) {
    instance *c = p; (void)fresh;
    c->t = t + h;
    c->local = 3.0 * c->y;
    c->y += h * (c->k * c->u + c->b);
    return 0;
}
int fmi2SetString(void *p, const unsigned vr[], size_t n, const char *const v[]) {
    instance *c = p; (void)vr; (void)n;
    strncpy(c->text, v[0], 15);
    return 0;
}
int fmi2GetString(void *p, const unsigned vr[], size_t n, const char *v[]) {
    instance *c = p; (void)vr;
    for (size_t i = 0; i < n; i++) v[i] = c->text;
    return 0;
}
"""
REALS = {0: "c->u", 1: "c->y", 2: "c->k", 3: "c->b", 4: "c->s[0]", 5: "c->s[1]"}
DOUBLED = REALS | {6: "2.0 * c->s[0]", 7: "2.0 * c->s[1]", 8: "c->local"}
WHOLE = {10: "c->mode", 11: "c->number"}
SUMMED = WHOLE | {12: "1000 * (int)strlen(c->text) + 100 * c->flag + 10 * c->mode + c->number"}
UNUSED = """GetTypesPlatform SetDebugLogging GetFMUstate SetFMUstate FreeFMUstate SerializedFMUstateSize
SerializeFMUstate DeSerializeFMUstate GetDirectionalDerivative SetRealInputDerivatives GetRealOutputDerivatives CancelStep
GetStatus GetRealStatus GetIntegerStatus GetBooleanStatus GetStringStatus"""
DESCRIPTION = """
<CoSimulation modelIdentifier="adder" canHandleVariableCommunicationStepSize="true"/>
<UnitDefinitions>
<Unit name="m"><BaseUnit m="1"/></Unit><Unit name="m/s"><BaseUnit m="1" s="-1"/></Unit>
</UnitDefinitions>
<TypeDefinitions><SimpleType name="Mode"><Enumeration><Item name="off" value="1"/><Item name="slow" value="2"/>
<Item name="fast" value="4"/></Enumeration></SimpleType></TypeDefinitions>
<ModelVariables>
<ScalarVariable name="u" valueReference="0" causality="input"><Real start="0" unit="m/s"/></ScalarVariable>
<ScalarVariable name="y" valueReference="1" causality="output" initial="exact"><Real start="0" unit="m"/></ScalarVariable>
<ScalarVariable name="k" valueReference="2" causality="parameter" variability="fixed"><Real start="1"/></ScalarVariable>
<ScalarVariable name="b" valueReference="3" causality="parameter" variability="fixed"><Real start="1" unit="m/s"/>
</ScalarVariable>
<ScalarVariable name="s[1]" valueReference="4" causality="input"><Real start="0"/></ScalarVariable>
<ScalarVariable name="s[2]" valueReference="5" causality="input"><Real start="0"/></ScalarVariable>
<ScalarVariable name="d[1]" valueReference="6" causality="output"><Real/></ScalarVariable>
<ScalarVariable name="d[2]" valueReference="7" causality="output"><Real/></ScalarVariable>
<ScalarVariable name="local" valueReference="8" causality="local"><Real unit="m"/></ScalarVariable>
<ScalarVariable name="mode" valueReference="10" causality="input" variability="discrete">
<Enumeration declaredType="Mode" start="1"/></ScalarVariable>
<ScalarVariable name="number" valueReference="11" causality="input" variability="discrete"><Integer start="0"/>
</ScalarVariable>
<ScalarVariable name="sum" valueReference="12" causality="output" variability="discrete"><Integer/></ScalarVariable>
<ScalarVariable name="flag" valueReference="13" causality="input" variability="discrete"><Boolean start="false"/>
</ScalarVariable>
<ScalarVariable name="text" valueReference="14" causality="parameter" variability="fixed"><String start=""/>
</ScalarVariable>
</ModelVariables>
<ModelStructure><Outputs><Unknown index="2"/><Unknown index="7"/><Unknown index="8"/><Unknown index="12"/></Outputs>
</ModelStructure>
"""
TEXTS = {"ssd": "Description", "ssc": "Common", "ssv": "ParameterValues", "ssm": "ParameterMapping"}
TEXTS["ssb"] = "SignalDictionary"
SPACES = " ".join(f'xmlns:{k}="http://ssp-standard.org/SSP1/SystemStructure{v}"' for k, v in TEXTS.items())


def adder(folder):
    """Build the FMU into a folder, and return its path."""
    functions = "".join(
        values("fmi2", verb, suffix, type_, cases)
        for verb, suffix, type_, cases in (
            ("Get", "Real", "double", DOUBLED),
            ("Set", "Real", "double", REALS),
            ("Get", "Integer", "int", SUMMED),
            ("Set", "Integer", "int", WHOLE),
            ("Get", "Boolean", "int", {13: "c->flag"}),
            ("Set", "Boolean", "int", {13: "c->flag"}),
        )
    )
    functions += "".join(f"int fmi2{name}(void) {{ return 3; }}\n" for name in UNUSED.split())
    return small_fmu(folder, "fmi2", SOURCE + functions, DESCRIPTION, name="adder")


def connectors(*given):
    """Return connectors, each "kind name", "kind name type" or "kind name Real unit"."""
    made = []
    for text in given:
        kind, name, *rest = text.split()
        type_ = rest[0] if rest else "Real"
        unit = f' unit="{rest[1]}"' if rest[1:] else ""
        made.append(f'<ssd:Connector name="{name}" kind="{kind}"><ssc:{type_}{unit}/></ssd:Connector>')
    return f"<ssd:Connectors>{''.join(made)}</ssd:Connectors>" if made else ""


def component(name, *given, source="resources/adder.fmu", bindings="", more=""):
    """Return a component."""
    return f'<ssd:Component name="{name}" source="{source}"{more}>{connectors(*given)}{bound(bindings)}</ssd:Component>'


def bound(bindings):
    """Return parameter bindings."""
    return f"<ssd:ParameterBindings>{bindings}</ssd:ParameterBindings>" if bindings else ""


def inline(values_="", mapping="", units="", more=""):
    """Return a parameter binding with its set, and the entries of its mapping, in it."""
    mapping = f"<ssd:ParameterMapping>{mapping_of(mapping)}</ssd:ParameterMapping>" if mapping else ""
    return (
        f"<ssd:ParameterBinding{more}><ssd:ParameterValues>{set_of(values_, units)}</ssd:ParameterValues>{mapping}"
        "</ssd:ParameterBinding>"
    )


def set_of(values_, units="", spaces=""):
    """Return a parameter set of "name=Type value" or "name=Type value unit" texts, separated by ``;``."""
    made = []
    for text in filter(None, values_.split(";")):
        name, _, rest = text.strip().partition("=")
        type_, value, *unit = rest.split()
        unit = f' unit="{unit[0]}"' if unit else ""
        made.append(f'<ssv:Parameter name="{name}"><ssv:{type_} value="{value}"{unit}/></ssv:Parameter>')
    units = f"<ssv:Units>{units}</ssv:Units>" if units else ""
    return (
        f'<ssv:ParameterSet version="1.0" name="set"{spaces}><ssv:Parameters>{"".join(made)}</ssv:Parameters>{units}'
        "</ssv:ParameterSet>"
    )


def mapping_of(entries, spaces=""):
    """Return a parameter mapping with these entries."""
    return f'<ssm:ParameterMapping version="1.0"{spaces}>{entries}</ssm:ParameterMapping>'


def connection(start, end, inside="", more=""):
    """Return a connection between "element.connector" or "connector" of the system."""
    ends = []
    for side, text in (("start", start), ("end", end)):
        element, _, name = text.rpartition(".")
        ends.append((f' {side}Element="{element}"' if element else "") + f' {side}Connector="{name}"')
    return f"<ssd:Connection{''.join(ends)}{more}>{inside}</ssd:Connection>"


def system(name, *elements, given=(), connections=(), bindings="", more="", attributes=""):
    """Return a system."""
    inside = f"<ssd:Elements>{''.join(elements)}</ssd:Elements>" if elements else ""
    wired = f"<ssd:Connections>{''.join(connections)}</ssd:Connections>" if connections else ""
    return (
        f'<ssd:System name="{name}"{attributes}>{connectors(*given)}{bound(bindings)}{inside}{wired}{more}</ssd:System>'
    )


def description(root, more="", version="1.0", name="test"):
    """Return a system structure description."""
    return (
        f'<?xml version="1.0" encoding="UTF-8"?>\n<ssd:SystemStructureDescription {SPACES} version="{version}" '
        f'name="{name}">{root}{more}</ssd:SystemStructureDescription>'
    )


def pack(path, files):
    """Write an archive of texts, bytes or files by their names, and return its path."""
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w") as archive:
        for name, content in files.items():
            archive.writestr(name, content if isinstance(content, str | bytes) else content.read_bytes())
    path.write_bytes(stream.getvalue())
    return path
