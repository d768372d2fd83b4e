//! The declared keys as a commented TOML file, and as a JSON Schema for editors.

use serde_json::{Map, Value as Json, json};

use super::{DefaultHolds, Key, Kind, Range, Rule, Words, expanded, join, tables};

/// Longest line of a comment, characters.
const LINE_MAX: usize = 100;

/// A configuration of all `keys` with their defaults, explained.
pub(crate) fn toml_reference(keys: &'static [Key]) -> String {
    let mut text = String::new();
    write_table(&mut text, keys, "", &[]);
    text
}

/// A JSON Schema of a configuration of these `keys`, for editors that complete and check TOML.
pub(crate) fn json_schema(keys: &'static [Key], title: &str) -> Json {
    let mut schema = table_schema(keys, &[], false);
    schema["$schema"] = "http://json-schema.org/draft-07/schema#".into();
    schema["title"] = title.into();
    schema
}

fn write_table(text: &mut String, keys: &'static [Key], path: &str, narrowed: &[(&str, Rule)]) {
    let is_section = |key: &&Key| matches!(key.kind, Kind::Table(_)) && key.default.is_none();
    let keys = expanded(keys, narrowed);
    for key in keys.iter().filter(|key| !is_section(key) || key.is_optional) {
        write_key(text, key, path);
    }
    for key in keys.iter().filter(|key| is_section(key) && !key.is_optional) {
        let path = join(path, key.name);
        text.push('\n');
        comment(text, "# ", key.text);
        text.push_str(&format!("[{path}]\n"));
        write_table(text, key.keys(), &path, key.narrowed);
    }
}

fn write_key(text: &mut String, key: &Key, path: &str) {
    text.push('\n');
    comment(text, "# ", &explanation(key));
    write_contents(text, key, "#   ");
    let name = key.name;
    text.push_str(&match (key.default, &key.kind) {
        (Some("[]"), Kind::Array(Kind::Table(_), _)) => format!("# [[{path}.{name}]]\n"),
        (Some(default), _) => format!("{name} = {default}\n"),
        (None, _) => format!("# {name} = …\n"),
    });
}

/// Explains what a key may hold, in lines that begin with `start`: the words of a choice, or the keys of a
/// table and what each of these may hold.
fn write_contents(text: &mut String, key: &Key, start: &str) {
    for (word, meaning) in words(&key.kind) {
        comment(text, start, &format!("\"{word}\": {meaning}"));
    }
    for (n, keys) in tables(&key.kind).into_iter().enumerate() {
        if n > 0 {
            comment(text, start, "or");
        }
        for inner in expanded(keys, key.narrowed) {
            let default = inner.default.map(|toml| format!(" Default: {toml}."));
            let explanation = explanation(&inner) + &default.unwrap_or_default();
            comment(text, start, &format!("{}: {explanation}", inner.name));
            write_contents(text, &inner, &format!("{start}  "));
        }
    }
}

/// The words of a choice, or of an array of choices, each with its meaning.
fn words(kind: &Kind) -> &'static [(&'static str, &'static str)] {
    match *kind {
        Kind::OneOf(words) => words,
        Kind::Array(element, _) => words(element),
        _ => &[],
    }
}

/// The documentation of a key, its allowed values, and whether hardware must give it.
fn explanation(key: &Key) -> String {
    let allowed = Words::of_key(key).allowed;
    let mut text = key.text.trim().to_owned();
    let is_plain = matches!(
        (key.kind, key.rule),
        (Kind::Boolean | Kind::OneOf(_) | Kind::Array(Kind::OneOf(_), _), _)
            | (Kind::Text, Rule::Any)
    );
    if !is_plain && tables(&key.kind).is_empty() {
        text.push_str(&format!(" Allowed: {allowed}"));
        text.push_str(&key.at_most.map(|max| format!(", at most {max}")).unwrap_or_default());
        text.push('.');
    }
    if let Some(other) = key.instead_of {
        text.push_str(&format!(" In place of {other}."));
    }
    if key.default_holds == DefaultHolds::ForEmulatedStage {
        text.push_str(match key.is_optional {
            true => " No default with hardware.",
            false => " Hardware must give it.",
        });
    }
    text
}

/// Adds `explanation` as lines that begin with `start`.
fn comment(text: &mut String, start: &str, explanation: &str) {
    let mut line = String::new();
    for word in explanation.split_whitespace() {
        let length = start.len() + line.chars().count() + 1 + word.chars().count();
        if !line.is_empty() && length > LINE_MAX {
            text.push_str(&format!("{start}{line}\n"));
            line.clear();
        }
        if !line.is_empty() {
            line.push(' ');
        }
        line.push_str(word);
    }
    text.push_str(&format!("{start}{line}\n"));
}

/// The schema of a table. If it `is_whole`, the keys without a default are required.
fn table_schema(keys: &'static [Key], narrowed: &[(&str, Rule)], is_whole: bool) -> Json {
    let keys = expanded(keys, narrowed);
    let properties = keys.iter().map(|key| (key.name.to_owned(), key_schema(key)));
    let mut schema = json!({
        "type": "object",
        "additionalProperties": false,
        "properties": properties.collect::<Map<_, _>>(),
    });
    let is_required = |key: &&Key| !key.is_optional && key.default.is_none();
    let required: Vec<&str> = keys.iter().filter(is_required).map(|key| key.name).collect();
    if is_whole && !required.is_empty() {
        schema["required"] = json!(required);
    }
    let exclusive = keys.iter().filter_map(|key| Some([key.name, key.instead_of?]));
    let exclusive: Vec<Json> = exclusive.map(|both| json!({ "required": both })).collect();
    if !exclusive.is_empty() {
        schema["not"] = json!({ "anyOf": exclusive });
    }
    schema
}

fn key_schema(key: &Key) -> Json {
    let mut schema = value_schema(&key.kind, &key.rule, key);
    schema["description"] = json!(explanation(key));
    if let Some(default) = key.default_value() {
        schema["default"] = json!(default);
    }
    schema
}

/// The schema of a value of this `kind` and `rule`: that of `key`, or of an element of it.
fn value_schema(kind: &Kind, rule: &Rule, key: &Key) -> Json {
    match (kind, *rule) {
        (_, Rule::Integers(values)) => json!({ "enum": values }),
        (_, Rule::Or(word, _)) => {
            json!({ "anyOf": [{ "const": word }, value_schema(kind, &Rule::Any, key)] })
        }
        (Kind::Number | Kind::Integer(..), _) => {
            let mut number = match kind.range(rule) {
                Some(Range { low, low_is_allowed, high }) => {
                    let minimum = if low_is_allowed { "minimum" } else { "exclusiveMinimum" };
                    json!({ minimum: low, "maximum": high })
                }
                None => json!({}),
            };
            let is_integer = matches!(kind, Kind::Integer(..));
            number["type"] = json!(if is_integer { "integer" } else { "number" });
            number
        }
        (Kind::Boolean, _) => json!({ "type": "boolean" }),
        (Kind::Text, _) => json!({ "type": "string" }),
        (Kind::OneOf(names), _) => {
            let meanings: Vec<&str> = names.iter().map(|(_, meaning)| meaning.trim()).collect();
            let names: Vec<&str> = names.iter().map(|(name, _)| *name).collect();
            json!({ "enum": names, "x-taplo": { "docs": { "enumValues": meanings } } })
        }
        (Kind::Array(inner, count), _) => {
            let mut array = json!({ "type": "array", "items": value_schema(inner, rule, key) });
            if let Some(count) = count {
                array["minItems"] = json!(count);
                array["maxItems"] = json!(count);
            }
            array
        }
        (Kind::Table(keys), _) => {
            table_schema(keys, key.narrowed, key.is_whole || matches!(key.kind, Kind::Array(..)))
        }
        (Kind::Either(_, tables), _) => {
            json!({ "anyOf": tables.map(|keys| table_schema(keys, &[], true)) })
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    crate::keys::section! {
        /// Two pairs of keys, of each of which one may be given.
        #[expect(unreachable_pub, reason = "a section is public")]
        pub struct Pairs {
            /// The first.
            a: Option<f64>;
            /// Its other.
            b: Option<f64>, instead_of("a");
            /// The second.
            c: Option<f64>;
            /// Its other.
            d: Option<f64>, instead_of("c");
        }
    }

    #[test]
    fn every_pair_of_keys_excludes_itself() {
        let excluded = json!({ "anyOf": [{ "required": ["b", "a"] }, { "required": ["d", "c"] }] });
        assert_eq!(json_schema(Pairs::KEYS, "")["not"], excluded);
    }
}
