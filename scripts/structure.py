#!/usr/bin/env python3
"""Prints figures of the workspace's structure: folders, long files and functions, options, duplicate names, doc comments.

Usage: scripts/structure.py [--list]   (--list also prints the items behind each figure)
"""
import os
import re
import subprocess
import sys
from collections import defaultdict

os.chdir(os.path.join(os.path.dirname(os.path.abspath(__file__)), ".."))
tracked = [f for f in subprocess.check_output(["git", "ls-files"], text=True).splitlines() if os.path.isfile(f)]
rust = [f for f in tracked if f.endswith(".rs")]
text = {f: open(f).read() for f in rust}


def is_test(path):
    """Tells test files from production files by their place and name."""
    parts = path.split("/")
    if parts[0] == "tests" or {"tests", "testing", "benches", "examples", "fuzz"} & set(parts[:-1]):
        return True
    return parts[-1] in ("tests.rs", "testing.rs") or parts[-1].endswith(("_tests.rs", "_properties.rs"))


def production(path):
    """Source without its inline test module, comments kept."""
    return re.split(r"\n#\[cfg\(test\)\]\n(?:#\[[^\n]*\]\n)*(?:pub\(crate\) )?mod \w+ \{", text[path])[0]


def blank(code):
    """Replaces comments, strings and characters by spaces, so that braces can be counted."""
    pattern = r'//[^\n]*|/\*.*?\*/|r(#*)".*?"\1|"(?:\\.|[^"\\])*"|\'(?:\\.[^\']*|[^\\\'])\''
    return re.sub(pattern, lambda m: re.sub(r"[^\n]", " ", m[0]), code, flags=re.S)


def long_functions():
    for path in rust:
        if is_test(path):
            continue
        code = blank(production(path))
        for match in re.finditer(r"\bfn (\w+)", code):
            start = re.compile(r"[{;]").search(code, match.end())
            if not start or start[0] == ";":
                continue
            depth, end = 0, start.start()
            for end in range(start.start(), len(code)):
                depth += {"{": 1, "}": -1}.get(code[end], 0)
                if depth == 0:
                    break
            lines = code.count("\n", match.start(), end) + 1
            if lines > 100:
                yield f"{path}: {match[1]} ({lines})"


def repeated_types():
    places = defaultdict(list)
    for path in rust:
        if not is_test(path):
            for name in re.findall(r"^pub(?:\([^)]*\))? (?:struct|enum|trait|union|type) (\w+)", production(path), re.M):
                places[name].append(path)
    return [f"{name}: {' '.join(paths)}" for name, paths in sorted(places.items()) if len(paths) > 1]


def odd_openings():
    pattern = re.compile(r"^\s*//[/!] (?:What|Who|How much|Of|By|The same)\b.*", re.M)
    openings = []
    for path in rust:
        lines = text[path].splitlines()
        for number, line in enumerate(lines):
            before = lines[number - 1].strip() if number else ""
            if pattern.match(line) and not re.match(r"//[/!] \S", before):
                openings.append(f"{path}:{number + 1}:{line.strip()}")
    return openings


def odd_lines():
    pattern = re.compile(r"^\s*//[/!] (?:What|Whatever|Who|Whoever|How much|How far|How many|Of|By|The same)\b.*", re.M)
    return [f"{path}:{match[0].strip()}" for path in rust for match in pattern.finditer(text[path])]


def fences():
    """Code fences of doc comments that are compiled; `ignore` and other languages do not count."""
    found = []
    for path in rust:
        inside = False
        for number, line in enumerate(text[path].splitlines()):
            match = re.match(r"\s*//[/!] ?```(.*)", line)
            if match:
                if not inside and match[1].strip() in ("", "rust", "no_run", "rust,no_run", "should_panic", "compile_fail"):
                    found.append(f"{path}:{number + 1}")
                inside = not inside
    return found


def cycles():
    """Strongly connected groups of files of one crate that import each other; crate roots and re-exports left out."""
    groups = []
    for crate in sorted({f.rsplit("/src/", 1)[0] for f in rust if "/src/" in f}):
        files = {}
        for path in rust:
            if path.startswith(f"{crate}/src/") and not is_test(path):
                module = path[len(crate) + 5 : -3]
                module = module[:-4] if module.endswith("/mod") else module
                if module not in ("lib", "main"):
                    files[module] = path
        edges = {module: set() for module in files}
        for module, path in files.items():
            code = re.sub(r"\bpub(?:\([^)]*\))? use [^;]*;", "", blank(production(path)))
            parent = module.rsplit("/", 1)[0] if "/" in module else ""
            for start in re.finditer(r"(?<!::)\b(?:crate|super|self)::", code):
                for target in expand(use_at(code, start.start())):
                    steps = target.split("::")
                    base = []
                    if steps[0] == "super":
                        base = parent.split("/") if parent else []
                        steps = steps[1:]
                        while steps and steps[0] == "super":
                            base, steps = base[:-1], steps[1:]
                    elif steps[0] == "self":
                        base, steps = (module.split("/") if module else []), steps[1:]
                    else:
                        steps = steps[1:]
                    known = None
                    for length in range(len(steps), -1, -1):
                        name = "/".join(base + steps[:length])
                        if name in files:
                            known = name
                            break
                    if known is not None and known != module:
                        edges[module].add(known)
            inside = f"{module}/" if module else ""
            for name in re.findall(r"(?<![:\w])(\w+)::", code):
                if inside + name in files:
                    edges[module].add(inside + name)
        for group in components(edges):
            if len(group) > 1:
                groups.append(" ".join(sorted(files[m] for m in group)))
    return groups


def use_at(code, start):
    """Returns the path that begins at `start`, with its nested braces."""
    depth = 0
    for end in range(start, len(code)):
        letter = code[end]
        depth += {"{": 1, "}": -1}.get(letter, 0)
        ends = letter == "}" and depth == 0 or depth < 0
        if ends or depth == 0 and not (letter.isalnum() or letter in "_:{"):
            return code[start : end + ends * (depth == 0)]
        if letter == "{" and code[end - 2 : end] != "::":
            return code[start:end]
    return code[start:]


def expand(use):
    """Splits `a::{b, c::d}` into `a::b` and `a::c::d`."""
    use = re.sub(r"\s+", " ", use)
    if "{" not in use:
        return [use]
    head, rest = use.split("{", 1)
    rest, parts, depth, current = rest.rsplit("}", 1)[0], [], 0, ""
    for letter in rest:
        depth += {"{": 1, "}": -1}.get(letter, 0)
        if letter == "," and depth == 0:
            parts.append(current)
            current = ""
        else:
            current += letter
    parts.append(current)
    return [item for part in parts if part.strip() for item in expand(head + part.strip())]


def components(edges):
    """Tarjan's strongly connected components."""
    index, low, stack, on, found, counter = {}, {}, [], set(), [], [0]

    def visit(node):
        index[node] = low[node] = counter[0]
        counter[0] += 1
        stack.append(node)
        on.add(node)
        for other in edges[node]:
            if other not in index:
                visit(other)
                low[node] = min(low[node], low[other])
            elif other in on:
                low[node] = min(low[node], index[other])
        if low[node] == index[node]:
            group = []
            while True:
                other = stack.pop()
                on.discard(other)
                group.append(other)
                if other == node:
                    break
            found.append(group)

    sys.setrecursionlimit(10000)
    for node in edges:
        if node not in index:
            visit(node)
    return found


def keys():
    path = next(f for f in tracked if f.endswith("flyrig/assets/default.toml"))
    return [f"{path}: {m[0]}" for m in re.finditer(r"^(?:# ?)?[a-z_0-9]+ = .*", open(path).read(), re.M)]


def matching(pattern, keep=lambda path: True):
    return [f"{path}: {match[0].strip()}" for path in rust if keep(path) for match in re.finditer(pattern, production(path))]


def size_kb(paths):
    return round(sum(os.path.getsize(path) for path in paths) / 1024)


def main():
    folders = sorted({f.split("/")[0] for f in tracked if "/" in f and not f.startswith(".")})
    curve = re.compile(r"0\.04045|0\.003_?130_?8|12\.92")
    rows = [
        ("top-level folders", folders),
        ("import cycles", cycles()),
        ("files > 600 lines", [f"{f}: {text[f].count(chr(10))}" for f in rust if text[f].count("\n") > 600]),
        ("functions > 100 lines", list(long_functions())),
        ("keys in rig.toml", keys()),
        ("#[arg]", matching(r"#\[arg.*")),
        ("production files with an sRGB curve", [f for f in rust if not is_test(f) and curve.search(production(f))]),
        ("type names declared twice", repeated_types()),
        ("doc comments that open What/Who/How much/Of/By/The same", odd_openings()),
        ("doc lines that begin with one of these words", odd_lines()),
        ("doc code fences that compile", fences()),
    ]
    for name, items in rows:
        print(f"{len(items):6}  {name}")
        if "--list" in sys.argv:
            for item in items:
                print(f"        {item}")
    for name, paths in (
        ("ARCHITECTURE", ["ARCHITECTURE.md"]),
        ("CHANGELOG", ["CHANGELOG.md"]),
        ("benchmark pages", [f for f in tracked if re.match(r"docs/benchmarks/[^/]*\.md$", f)]),
    ):
        print(f"{size_kb(paths):6}  KB {name}")


main()
