//! Rules of zenoh's access control: what holders of keys may do in a session, and what a session with a key accepts.
//!
//! Everything is denied that no rule allows. The gate connects each holder under a common name of its role and number
//! ([`Inner::name`]), so rules for all numbers are there from the start: a key that is added later needs no new session.

use flyrig_access::{Inner, KeyFile, MAX_HOLDERS, Ring, Role};
use serde_json::{Value, json};

use crate::keys;

const ALL: [&str; 9] = [
    "put",
    "delete",
    "declare_subscriber",
    "query",
    "declare_queryable",
    "reply",
    "liveliness_token",
    "liveliness_query",
    "declare_liveliness_subscriber",
];
/// zenoh's names of what comes from a holder, and of what goes to it.
const FROM: &str = "ingress";
const TO: &str = "egress";

fn rule(id: &str, flow: &str, messages: &[&str], key_exprs: &[String]) -> Value {
    json!({ "id": id, "permission": "allow", "flows": [flow], "messages": messages, "key_exprs": key_exprs })
}

/// Rules of the side behind a gate: programs of this computer may do everything, holders what their role lets them.
pub(crate) fn behind_gate(ring: &Ring, roles: &[Role]) -> Value {
    let rig = ring.rig();
    let key = |rest: &str| keys::key(rig, rest);
    let alive = [keys::any_version_alive(rig)];
    let mut rules =
        vec![rule("local-from", FROM, &ALL, &["**".to_owned()]), rule("local-to", TO, &ALL, &["**".to_owned()])];
    let mut subjects = vec![json!({ "id": "local", "link_protocols": ["tcp"] })];
    let mut policies = vec![json!({ "rules": ["local-from", "local-to"], "subjects": ["local"] })];

    let watched: Vec<String> =
        ["person/**", "view/*", "stats", "calibration/*", "transforms", "splats", "splats/*"].map(key).to_vec();
    let templates = [key("template/*")];
    let all_viewpoints = [key("viewpoint/*")];
    rules.extend([
        rule("watch-to", TO, &["put"], &watched),
        rule("watch-from", FROM, &["declare_subscriber"], &watched),
        rule("templates-from", FROM, &["query"], &templates),
        rule("templates-to", TO, &["reply", "declare_queryable"], &templates),
        rule("viewpoints-to", TO, &["declare_queryable"], &all_viewpoints),
        rule("alive-to", TO, &["liveliness_token"], &alive),
        rule("alive-from", FROM, &["liveliness_query", "declare_liveliness_subscriber"], &alive),
    ]);
    let watching =
        ["watch-to", "watch-from", "templates-from", "templates-to", "viewpoints-to", "alive-to", "alive-from"];

    let images: Vec<String> = ["camera/*", "camera-status/*"].map(key).to_vec();
    let (clocks, hosts) = ([key("clock/*")], [keys::ANY_HOST.to_owned()]);
    rules.extend([
        rule("cameras-from", FROM, &["put"], &images),
        rule("cameras-to", TO, &["declare_subscriber"], &images),
        rule("clocks-from", FROM, &["declare_queryable", "reply"], &clocks),
        rule("clocks-to", TO, &["query"], &clocks),
        rule("hosts-from", FROM, &["liveliness_token"], &[key("host/*")]),
        rule("hosts-to", TO, &["liveliness_query", "declare_liveliness_subscriber"], &hosts),
    ]);
    let sending = ["cameras-from", "cameras-to", "clocks-from", "clocks-to", "hosts-from", "hosts-to"];

    for role in roles {
        for number in 0..MAX_HOLDERS {
            let name = Inner::name(*role, number);
            let mut allowed: Vec<String> = Vec::new();
            match role {
                Role::Cameras => allowed.extend(sending.map(str::to_owned)),
                Role::Viewer | Role::Relay => {
                    // A relay's viewers have names of its own ring, which it keeps apart itself.
                    let own = if *role == Role::Viewer { ring.names_of(number) } else { "*".to_owned() };
                    let view = [key(&format!("viewer/{own}/view"))];
                    let viewpoint = [key(&format!("viewpoint/{own}"))];
                    let token = [key(&format!("viewer/{own}/alive"))];
                    let own_rules = [
                        rule(&format!("{name}-view-to"), TO, &["put"], &view),
                        rule(&format!("{name}-view-from"), FROM, &["declare_subscriber"], &view),
                        rule(&format!("{name}-viewpoint-from"), FROM, &["query"], &viewpoint),
                        rule(&format!("{name}-viewpoint-to"), TO, &["reply"], &viewpoint),
                        rule(&format!("{name}-alive-from"), FROM, &["liveliness_token"], &token),
                    ];
                    allowed.extend(watching.map(str::to_owned));
                    allowed.extend(own_rules.iter().filter_map(|rule| Some(rule.get("id")?.as_str()?.to_owned())));
                    rules.extend(own_rules);
                }
            }
            subjects.push(json!({ "id": name, "cert_common_names": [name] }));
            policies.push(json!({ "rules": allowed, "subjects": [name] }));
        }
    }
    control(rules, subjects, policies)
}

/// Rules of the side with a key: only the rig's own certificate counts. zenoh trusts the web's public authorities, too.
pub(crate) fn with_key(key: &KeyFile) -> Value {
    let everything = ["**".to_owned()];
    control(
        vec![rule("rig-from", FROM, &ALL, &everything), rule("rig-to", TO, &ALL, &everything)],
        vec![json!({ "id": "rig", "cert_common_names": [key.rig_certificate_name] })],
        vec![json!({ "rules": ["rig-from", "rig-to"], "subjects": ["rig"] })],
    )
}

fn control(rules: Vec<Value>, subjects: Vec<Value>, policies: Vec<Value>) -> Value {
    json!({ "enabled": true, "default_permission": "deny", "rules": rules, "subjects": subjects, "policies": policies })
}
