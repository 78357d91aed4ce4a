//! Inside a module the arrows go one way too: no file or folder uses a sibling that uses it, however long the way round.
//!
//! An arrow is a `use`, or a path in the code, that names what another file defines; a name that `mod.rs` hands on counts for the file
//! that defines it. What `mod.rs` itself defines is one more sibling. Only names are followed: a method is not.

use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::path::Path;

use crate::architecture::rust_files;

/// `render::cpu` in its parts; none for the crate's root.
type Module = Vec<String>;

/// What `mod.rs` defines, among its siblings.
const PARENT: &str = "mod.rs";

/// Re-exports of re-exports that are followed.
const DEEPEST: usize = 16;

/// A file by the names in it.
#[derive(Default)]
struct Source {
    /// Modules that it declares, those of tests left out.
    children: BTreeSet<String>,
    /// What it imports: the path, and the name that stands for it.
    imports: Vec<(Vec<String>, String)>,
    /// Paths of two parts and more in its code.
    paths: BTreeSet<Vec<String>>,
    /// Every word of its code outside `use`.
    words: BTreeSet<String>,
}

/// Words and signs of `text`, without comments and without what stands in quotes.
fn tokens(text: &str) -> Vec<String> {
    let chars: Vec<char> = text.chars().collect();
    let is_word = |at: usize| chars.get(at).is_some_and(|c| c.is_alphanumeric() || *c == '_');
    let is = |at: usize, sign: &str| sign.chars().enumerate().all(|(n, c)| chars.get(at + n) == Some(&c));
    let after = |from: usize, end: &str| (from..chars.len()).find(|at| is(*at, end)).map_or(chars.len(), |at| at + end.len());
    let (mut found, mut at) = (Vec::new(), 0);
    while at < chars.len() {
        let end = (at..).find(|at| !is_word(*at)).unwrap_or(at);
        let word: String = chars[at..end].iter().collect();
        let fences = (end..).take_while(|at| is(*at, "#")).count();
        if is(at, "//") {
            at = after(at, "\n");
        } else if is(at, "/*") {
            at = after(at, "*/");
        } else if matches!(word.as_str(), "r" | "br") && is(end + fences, "\"") {
            at = after(end + fences + 1, &format!("\"{}", "#".repeat(fences)));
        } else if !word.is_empty() {
            at = end;
            found.push(word);
        } else if is(at, "\"") {
            at += 1;
            while at < chars.len() && !is(at, "\"") {
                at += if is(at, "\\") { 2 } else { 1 };
            }
            at += 1;
        } else if is(at, "'\\") {
            at = after(at + 3, "'");
        } else if is(at + 2, "'") && is(at, "'") {
            at += 3;
        } else if is(at, "'") {
            // A lifetime's name is no word.
            at = (at + 1..).find(|at| !is_word(*at)).unwrap_or(at);
        } else if is(at, "::") {
            at += 2;
            found.push("::".to_owned());
        } else {
            found.extend(Some(chars[at].to_string()).filter(|sign| !sign.trim().is_empty()));
            at += 1;
        }
    }
    found
}

/// Paths and names of a `use` without its first word and its semicolon.
fn imports_of(tree: &[String], before: &[String]) -> Vec<(Vec<String>, String)> {
    let mut path = before.to_vec();
    let mut at = 0;
    while at < tree.len() {
        match tree[at].as_str() {
            "{" => {
                let mut found = Vec::new();
                let (mut depth, mut from) = (0, at + 1);
                for (end, sign) in tree.iter().enumerate().skip(at) {
                    match sign.as_str() {
                        "{" => depth += 1,
                        "}" => depth -= 1,
                        _ => {}
                    }
                    if depth == 0 || depth == 1 && sign == "," {
                        found.extend(imports_of(&tree[from..end], &path));
                        from = end + 1;
                    }
                }
                return found;
            }
            "as" => return vec![(path, tree[at + 1].clone())],
            "::" | "self" if !path.is_empty() => {}
            part => path.push(part.to_owned()),
        }
        at += 1;
    }
    let name = path.last().cloned();
    name.filter(|_| !tree.is_empty()).map(|name| (path, name)).into_iter().collect()
}

impl Source {
    fn of(text: &str) -> Self {
        let tokens = tokens(text);
        let word = |at: usize| tokens.get(at).map_or("", String::as_str);
        let mut source = Self::default();
        // Braces that are open, and those of modules written within the file.
        let (mut open, mut within) = (0usize, Vec::new());
        let mut at = 0;
        while at < tokens.len() {
            if ["#", "[", "cfg", "(", "test", ")", "]"].iter().enumerate().all(|(n, sign)| word(at + n) == *sign) {
                at = end_of_item(&tokens, at + 7);
                continue;
            }
            match (word(at), word(at + 2)) {
                ("use", _) if word(at + 1) != "<" => {
                    let end = (at..tokens.len()).find(|end| word(*end) == ";").unwrap_or(tokens.len());
                    let local = imports_of(&tokens[at + 1..end], &[]).into_iter();
                    source.imports.extend(local.map(|(path, name)| (of_file(path, within.len()), name)));
                    at = end;
                }
                ("mod", ";") => {
                    source.children.insert(word(at + 1).to_owned());
                    at += 2;
                }
                ("mod", "{") => {
                    within.push(open);
                    at += 1;
                }
                ("{", _) => open += 1,
                ("}", _) => {
                    open -= 1;
                    within.pop_if(|before| *before == open);
                }
                (first, _) if first.starts_with(|c: char| c.is_alphabetic() || c == '_') => {
                    let named = at == 0 || !matches!(word(at - 1), "." | "::");
                    let mut path = vec![first.to_owned()];
                    while word(at + 1) == "::" && word(at + 2).starts_with(|c: char| c.is_alphabetic() || c == '_') {
                        at += 2;
                        path.push(word(at).to_owned());
                    }
                    if named {
                        source.words.insert(path[0].clone());
                        source.paths.extend(Some(of_file(path, within.len())).filter(|path| path.len() > 1));
                    }
                }
                _ => {}
            }
            at += 1;
        }
        source
    }
}

/// A path as it reads outside `levels` modules that are written within the file.
fn of_file(path: Vec<String>, levels: usize) -> Vec<String> {
    let up = path.iter().take(levels).take_while(|part| *part == "super").count();
    if up == 0 {
        return path;
    }
    let outside = path.get(up).is_some_and(|part| part == "super");
    let file = (!outside).then(|| "self".to_owned());
    file.into_iter().chain(path[up..].iter().cloned()).collect()
}

/// One past the item that begins at `at`.
fn end_of_item(tokens: &[String], at: usize) -> usize {
    let mut open = 0;
    for (n, token) in tokens.iter().enumerate().skip(at) {
        match token.as_str() {
            "{" => open += 1,
            "}" => open -= 1,
            _ => {}
        }
        if open == 0 && matches!(token.as_str(), "}" | ";") {
            return n + 1;
        }
    }
    tokens.len()
}

/// Every file that the crate declares.
struct Crate {
    sources: BTreeMap<Module, Source>,
}

/// Arrows between siblings: from, to, and what is used where.
type Arrows = BTreeMap<String, BTreeMap<String, String>>;

impl Crate {
    /// Of files by their module.
    fn of(texts: &BTreeMap<Module, String>) -> Self {
        let mut sources = BTreeMap::new();
        let mut waiting = vec![Module::new()];
        while let Some(module) = waiting.pop() {
            let Some(text) = texts.get(&module) else { continue };
            let source = Source::of(text);
            waiting.extend(source.children.iter().map(|child| [module.clone(), vec![child.clone()]].concat()));
            sources.insert(module, source);
        }
        Self { sources }
    }

    /// The module that defines what `path` names in `module`, and the name there, empty for the module itself; `None` outside the crate.
    fn find(&self, module: &[String], path: &[String], deeper: usize) -> Option<(Module, String)> {
        let up = path.iter().take_while(|part| *part == "super").count();
        let (mut at, mut rest) = match path.first()?.as_str() {
            "crate" => (Module::new(), &path[1..]),
            "self" => (module.to_vec(), &path[1..]),
            "super" => (module[..module.len().checked_sub(up)?].to_vec(), &path[up..]),
            first => {
                let own = self.sources.get(module)?;
                if !own.children.contains(first) && !own.imports.iter().any(|(whole, name)| name == first && whole != path) {
                    return None;
                }
                (module.to_vec(), path)
            }
        };
        while let (Some(first), Some(source)) = (rest.first(), self.sources.get(&at)) {
            if source.children.contains(first) {
                at.push(first.clone());
            } else if let Some((whole, _)) = source.imports.iter().find(|(_, name)| name == first) {
                let (module, name) = self.find(&at, whole, deeper.checked_sub(1)?)?;
                if !name.is_empty() {
                    return Some((module, name));
                }
                at = module;
            } else {
                return Some((at, first.clone()));
            }
            rest = &rest[1..];
        }
        Some((at, String::new()))
    }

    /// What a file uses of others. What one with children only hands on to them, or from them, it does not use.
    fn used(&self, module: &Module) -> BTreeSet<(Module, String)> {
        let source = &self.sources[module];
        let imports = source.imports.iter().filter(|(_, name)| source.children.is_empty() || source.words.contains(name));
        let paths = imports.map(|(path, _)| path).chain(&source.paths);
        let found = paths.filter_map(|path| self.find(module, path, DEEPEST));
        found.filter(|(used, name)| !(name.is_empty() && module.starts_with(used))).collect()
    }

    /// The arrows between siblings, by folder.
    fn arrows(&self) -> BTreeMap<Module, Arrows> {
        let mut all: BTreeMap<Module, Arrows> = BTreeMap::new();
        for module in self.sources.keys() {
            for (used, name) in self.used(module) {
                // They part in one folder; above it they are one, below it they are no siblings.
                let depth = module.iter().zip(&used).take_while(|(own, other)| own == other).count();
                let sibling = |module: &Module| module.get(depth).map_or(PARENT, String::as_str).to_owned();
                let (from, to) = (sibling(module), sibling(&used));
                if from != to {
                    let what = used.iter().chain(Some(&name).filter(|name| !name.is_empty())).cloned().collect::<Vec<_>>();
                    let words = format!("{} uses {}", module.join("::"), what.join("::"));
                    all.entry(module[..depth].to_vec()).or_default().entry(from).or_default().entry(to).or_insert(words);
                }
            }
        }
        all
    }
}

/// The shortest way from a sibling back to itself, arrow by arrow.
fn cycle(arrows: &Arrows) -> Option<Vec<String>> {
    let way_back = |start: &String| {
        let mut waiting = VecDeque::from([vec![start]]);
        let mut seen = BTreeSet::new();
        while let Some(way) = waiting.pop_front() {
            for to in arrows.get(way[way.len() - 1]).into_iter().flat_map(BTreeMap::keys) {
                let longer = [way.clone(), vec![to]].concat();
                if to == start {
                    return Some(longer.windows(2).map(|pair| arrows[pair[0]][pair[1]].clone()).collect::<Vec<String>>());
                }
                if seen.insert(to) {
                    waiting.push_back(longer);
                }
            }
        }
        None
    };
    arrows.keys().filter_map(way_back).min_by_key(Vec::len)
}

/// A cycle of each folder that has one, in words.
fn cycles(arrows: &BTreeMap<Module, Arrows>) -> Vec<String> {
    let words = |folder: &Module, cycle: Vec<String>| format!("src/{}: {}", folder.join("/"), cycle.join(", "));
    arrows.iter().filter_map(|(folder, arrows)| Some(words(folder, cycle(arrows)?))).collect()
}

#[test]
fn siblings_do_not_use_each_other_in_a_circle() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("src");
    let mut files = Vec::new();
    rust_files(&root, &mut files);
    let mut texts = BTreeMap::new();
    for file in files {
        let relative = file.strip_prefix(&root).expect("below src").with_extension("");
        let mut module: Module = relative.iter().map(|part| part.to_string_lossy().into_owned()).collect();
        module.pop_if(|last| matches!(last.as_str(), "mod" | "lib"));
        texts.insert(module, std::fs::read_to_string(&file).expect("source is text"));
    }
    let all = Crate::of(&texts).arrows();
    let count: usize = all.values().flat_map(BTreeMap::values).map(BTreeMap::len).sum();
    assert!(all.len() > 20 && count > 1000, "{} folders, {count} arrows", all.len());
    let found = cycles(&all);
    assert!(found.is_empty(), "move what both use into a file below them:\n{}", found.join("\n"));
}

/// The control: circles are found however they are written, and what is none is not taken for one.
#[test]
fn a_circle_of_siblings_is_found() {
    let of = |files: &[(&str, &str)]| {
        let module = |path: &str| path.split("::").filter(|part| !part.is_empty()).map(str::to_owned).collect::<Module>();
        let mut texts: BTreeMap<Module, String> = files.iter().map(|(path, text)| (module(path), (*text).to_owned())).collect();
        texts.insert(Module::new(), "pub mod m; pub mod other;".to_owned());
        texts.insert(module("other"), "pub struct Far;".to_owned());
        cycles(&Crate::of(&texts).arrows())
    };
    let parent = "mod a; mod b; mod c; pub use a::A; pub use b::{B, b as bee};";
    let circles = [
        ("use super::b::B; pub struct A;", "use super::a::A; pub struct B;"),
        ("use super::B; pub struct A;", "use super::A; pub struct B;"),
        ("use crate::m::{b::{self, B}}; pub struct A;", "pub fn b() -> super::A {}"),
        ("pub fn a() { super::bee() }", "use crate::{m::a, other::Far}; pub fn b() { a::a() }"),
        ("pub fn a() { super::c::c() }", "use super::a; pub fn b() { a::a() }"),
        ("mod inner { use super::super::b::B; } pub struct A;", "pub struct B { a: super::a::A }"),
        ("const QUOTE: char = '\\''; use super::b::B; pub struct A;", "fn b<'a>() -> &'a str { r#\"\"\"# } use super::a::A;"),
    ];
    for (a, b) in circles {
        let found = of(&[("m", parent), ("m::a", a), ("m::b", b), ("m::c", "pub fn c() { super::b::b() }")]);
        assert!(found.len() == 1 && found[0].starts_with("src/m: m::a uses m::"), "{a} and {b}: {found:?}");
    }
    let with_parent = [
        ("mod a; pub struct P; fn p() { a::a() }", "use super::P; pub fn a() {}"),
        ("mod a; use a::A; pub struct P { a: A }", "pub struct A; impl crate::m::P {}"),
    ];
    for (parent, a) in with_parent {
        assert_eq!(of(&[("m", parent), ("m::a", a)]).len(), 1, "{parent} and {a}");
    }
    let folder = ("m::b::x", "use super::super::a::A; pub struct X;");
    assert_eq!(of(&[("m", "mod a; mod b;"), ("m::a", "use super::b::x::X;"), ("m::b", "pub mod x;"), folder]).len(), 1);
    let harmless = [
        (parent, "pub struct A;", "use super::A; pub struct B; // super::a uses crate::m::b::B"),
        (parent, "pub struct A; const A: &str = \"super::b::B\";", "use super::A; /* in a.rs: use super::b::B; */"),
        (parent, "pub struct A; #[cfg(test)] mod tests { use super::super::b::B; }", "use super::a::A;"),
        (parent, "mod inner { use super::A; } pub struct A;", "use super::a::A; use super::a::A as B;"),
        ("mod a; mod b; pub struct P; pub use a::A;", "use super::P; pub struct A;", "use super::{A, P};"),
        ("mod a; #[cfg(test)] mod b;", "pub struct A; use super::b::B;", "use super::a::A;"),
    ];
    for (parent, a, b) in harmless {
        let found = of(&[("m", parent), ("m::a", a), ("m::b", b), ("m::c", "")]);
        assert!(found.is_empty(), "{a} and {b}: {found:?}");
    }
}
